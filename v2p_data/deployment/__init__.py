"""A trained policy on an arm: pictures become masks by tracking from clicks, actions pass limits, runs are recorded.

In: a policy's folder and a robot (`robot.RobotWithCamera`). Out: motion, or one sentence why there is none; the
recording is a LeRobot dataset. Nothing here knows where objects are but what the pictures show.
"""
