"""One task code becomes the best reward found.

In: a `TaskBundle` and a trainer that is passed in. What a trained policy did comes back as `Trajectories`
(`record.record_trajectories` plays them, one `.npz` each); `feedback.feedback_of` boils them down to a table;
`reflect.reflect` reads the table and writes the next rewards as code, each with its reasons; to that end
`reward_code.Reward` takes a reward apart, changes parts and writes it again. `prescreen.prescreen` turns away rewards that
rank stored failures above stored successes before anything is trained with them. Out: task code that differs from its
parent in the reward only.
"""
