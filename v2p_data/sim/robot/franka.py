"""The built-in arm as MJCF: a Franka-Panda-like arm with a 2F-85-like gripper, read as any other arm is (`arms`).

Kinematics, joint limits, link masses and inertias are Franka Emika's published values; `robot` has
the kinematics in closed form. What touches, what drives it and how its joints are damped is the
reader's.
"""

FRANKA_BODIES = """
<geom name="link0_0" type="cylinder" fromto="0 0 0 0 0 0.14" size="0.07" contype="0" conaffinity="0"
 rgba="0.93 0.93 0.95 1"/>
<body name="link1" pos="0 0 0.333">
 <inertial mass="4.970684" pos="0.003875 0.002081 -0.04762"
  fullinertia="0.70337 0.70661 0.009117 -0.000139 0.006772 0.019169"/>
 <joint name="joint1" axis="0 0 1" range="-2.8973 2.8973"/>
 <geom name="link1_0" type="capsule" fromto="0 0 -0.19 0 0 0" size="0.06" rgba="0.93 0.93 0.95 1"/>
 <body name="link2" euler="-1.5707963267948966 0 0">
  <inertial mass="0.646926" pos="-0.003141 -0.02872 0.003495"
   fullinertia="0.007962 0.02811 0.025995 -0.003925 0.010254 0.000704"/>
  <joint name="joint2" axis="0 0 1" range="-1.7628 1.7628"/>
  <geom name="link2_0" type="capsule" fromto="0 0 -0.05 0 0 0.05" size="0.06" rgba="0.93 0.93 0.95 1"/>
  <geom name="link2_1" type="capsule" fromto="0 -0.06 0 0 -0.19 0" size="0.06" rgba="0.93 0.93 0.95 1"/>
  <body name="link3" pos="0 -0.316 0" euler="1.5707963267948966 0 0">
   <inertial mass="3.228604" pos="0.027518 0.039252 -0.066502"
    fullinertia="0.037242 0.036155 0.01083 -0.004761 -0.011396 -0.012805"/>
   <joint name="joint3" axis="0 0 1" range="-2.8973 2.8973"/>
   <geom name="link3_0" type="capsule" fromto="0 0 -0.12 0 0 0" size="0.055" rgba="0.93 0.93 0.95 1"/>
   <geom name="link3_1" type="capsule" fromto="0.0825 0 0 0.0825 0.06 0" size="0.05" rgba="0.93 0.93 0.95 1"/>
   <body name="link4" pos="0.0825 0 0" euler="1.5707963267948966 0 0">
    <inertial mass="3.587895" pos="-0.05317 0.104419 0.027454"
     fullinertia="0.025853 0.019552 0.028323 0.007796 -0.001332 0.008641"/>
    <joint name="joint4" axis="0 0 1" range="-3.0718 -0.0698"/>
    <geom name="link4_0" type="capsule" fromto="0 0 -0.05 0 0 0.05" size="0.055" rgba="0.93 0.93 0.95 1"/>
    <geom name="link4_1" type="capsule" fromto="-0.0825 0.08 0 -0.0825 0.14 0" size="0.05" rgba="0.93 0.93 0.95 1"/>
    <body name="link5" pos="-0.0825 0.384 0" euler="-1.5707963267948966 0 0">
     <inertial mass="1.225946" pos="-0.011953 0.041065 -0.038437"
      fullinertia="0.035549 0.029474 0.008627 -0.002117 -0.004037 0.000229"/>
     <joint name="joint5" axis="0 0 1" range="-2.8973 2.8973"/>
     <geom name="link5_0" type="capsule" fromto="0 0 -0.24 0 0 -0.17" size="0.055" rgba="0.93 0.93 0.95 1"/>
     <geom name="link5_1" type="capsule" fromto="0 0.05 -0.2 0 0.07 -0.02" size="0.035" rgba="0.93 0.93 0.95 1"/>
     <body name="link6" euler="1.5707963267948966 0 0">
      <inertial mass="1.666555" pos="0.060149 -0.014117 -0.010517"
       fullinertia="0.001964 0.004354 0.005433 0.000109 -0.001158 0.000341"/>
      <joint name="joint6" axis="0 0 1" range="-0.0175 3.7525"/>
      <geom name="link6_0" type="capsule" fromto="0 0 -0.05 0 0 0.03" size="0.045" rgba="0.93 0.93 0.95 1"/>
      <geom name="link6_1" type="capsule" fromto="0.03 0 0 0.088 0 0" size="0.045" rgba="0.93 0.93 0.95 1"/>
      <body name="link7" pos="0.088 0 0" euler="1.5707963267948966 0 0">
       <inertial mass="0.735522" pos="0.010517 -0.004252 0.061597"
        fullinertia="0.012516 0.010027 0.004815 -0.000428 -0.001196 -0.000741"/>
       <joint name="joint7" axis="0 0 1" range="-2.8973 2.8973"/>
       <geom name="link7_0" type="capsule" fromto="0 0 -0.02 0 0 0.08" size="0.042" rgba="0.93 0.93 0.95 1"/>
       <body name="hand" pos="0 0 0.107" euler="0 0 -0.7853981633974483">
        <inertial mass="0.8" pos="0 0 0.045" diaginertia="9e-4 9e-4 5e-4"/>
        <geom name="palm" type="box" pos="0 0 0.045" size="0.035 0.05 0.045" rgba="0.15 0.15 0.17 1"/>
        <site name="tcp" pos="0 0 0.145" size="0.005" group="4"/>
        <body name="finger_left" pos="0 0 0.12">
         <inertial mass="0.03" pos="0 0.006 0.01" diaginertia="1e-5 1e-5 1e-5"/>
         <joint name="finger_left" type="slide" axis="0 1 0" range="0 0.0425"/>
         <geom name="pad_left" type="box" pos="0 0.006 0.0075" size="0.011 0.006 0.0325" rgba="0.3 0.3 0.32 1"/>
        </body>
        <body name="finger_right" pos="0 0 0.12">
         <inertial mass="0.03" pos="0 -0.006 0.01" diaginertia="1e-5 1e-5 1e-5"/>
         <joint name="finger_right" type="slide" axis="0 -1 0" range="0 0.0425"/>
         <geom name="pad_right" type="box" pos="0 -0.006 0.0075" size="0.011 0.006 0.0325" rgba="0.3 0.3 0.32 1"/>
        </body>
       </body>
      </body>
     </body>
    </body>
   </body>
  </body>
 </body>
</body>
"""
"""What stands in a `<worldbody>`; angles are in radians."""
