"""MJCF of kinds of robots: the elements that published models use, with numbers of our own."""

ARM = """<mujoco model="arm"><compiler angle="degree" autolimits="true"/><option gravity="0 0.5 -9.7"/>
<default><joint axis="0 1 0" damping="0.5" armature="0.1"/><default class="small"><joint armature="0.02"
 frictionloss="0.3"/></default></default>
<worldbody><geom type="plane" size="1 1 .1"/><body name="base" pos="0 0 .1"><geom type="box" size=".1 .1 .1"/>
 <body name="upper" pos="0 0 .1" euler="10 20 30"><joint name="shoulder" pos=".02 .01 -.03" range="-90 80" ref="15"/>
  <joint name="roll" axis="1 0 1" pos="0 .02 0" class="small"/>
  <geom type="capsule" fromto="0 0 0 0 0 .4" size=".04"/><site name="elbow site" pos="0 0 .4" euler="0 90 0"/>
  <body name="fore" pos="0 0 .4"><joint name="elbow" class="small" range="-1 150" actuatorfrcrange="-20 20"/>
   <inertial pos=".01 .02 .2" mass="1.2" fullinertia=".03 .02 .015 .001 -.002 .003"/>
   <geom type="mesh" mesh="absent"/>
   <body pos="0 0 .3"><joint type="slide" axis="0 0 1" range="0 .2" ref=".05"/>
    <geom type="sphere" size=".05" mass=".3"/></body></body></body></body></worldbody>
<asset><mesh name="absent" file="absent.stl"/></asset>
<actuator><motor joint="shoulder" gear="50" ctrlrange="-1 1"/><motor joint="roll" gear="2" forcerange="-3 4"/>
</actuator></mujoco>"""

GRIPPER = """<mujoco model="gripper"><worldbody><body name="palm"><joint name="lift" type="slide" axis="0 0 1"/>
 <geom type="box" size=".05 .03 .02"/>
 <body name="left" pos="0 .02 .03"><joint name="left" type="slide" axis="0 1 0" armature=".2" range="0 .04"
  damping="2"/>
  <geom type="box" size=".01 .005 .03"/></body>
 <body name="right" pos="0 -.02 .03"><joint name="right" axis="1 0 0" pos="0 0 -.01" ref="10" armature=".3"
  damping="1"/>
  <geom type="box" size=".01 .005 .03" pos="0 0 .03"/></body></body></worldbody>
<equality><joint joint1="right" joint2="left" polycoef=".02 -1.5 0 0 0"/></equality></mujoco>"""

LEG = """<body name="{0}_thigh" pos="{1} {2} 0" euler="0 0 {3}"><joint name="{0}_hip" axis="1 0 0"/>
<joint name="{0}_pitch" axis="0 1 0" pos="0 .02 0"/><geom type="capsule" fromto="0 0 0 .05 0 -.2" size=".02"/>
<body name="{0}_shank" pos=".05 0 -.2"><joint name="{0}_knee" axis="0 1 0" armature=".01"/>
<geom type="capsule" fromto="0 0 0 -.05 0 -.2" size=".015"/><site name="{0}_foot" pos="-.05 0 -.2"/></body></body>"""
LEGS = "".join(
    LEG.format(name, x, y, turn)
    for name, x, y, turn in (("fl", 0.2, 0.1, 0), ("fr", 0.2, -0.1, 5), ("hl", -0.2, 0.1, 9))
)
QUADRUPED = f"""<mujoco model="dog"><worldbody><body name="trunk" pos="0 0 .5"><freejoint/>
<geom type="box" size=".25 .1 .05" pos=".01 .02 0"/><site name="imu"/>{LEGS}</body></worldbody></mujoco>"""

QUADROTOR = """<mujoco model="quad"><worldbody><body name="frame"><freejoint name="root"/>
<inertial pos="0 .01 0" mass="1.3" diaginertia=".03 .031 .025" euler="3 2 1"/>
<site name="r1" pos=".1 .1 0"/><site name="r2" pos="-.1 .1 0"/>
<site name="r3" pos="-.1 -.1 0"/><site name="r4" pos=".1 -.1 0"/>
</body></worldbody><actuator>
<motor name="1" site="r1" gear="0 0 1 0 0 -.02"/><motor name="2" site="r2" gear="0 0 1 0 0 .02"/>
<motor name="3" site="r3" gear="0 0 1 0 0 -.02"/><motor name="4" site="r4" gear="0 0 1 0 0 .02"/></actuator></mujoco>"""

CHAIN = """<mujoco model="chain"><worldbody><body name="post"><geom size=".1"/>
<body name="first" pos="0 .1 0" euler="0 0 20"><joint name="roll" axis="1 0 0" pos="0 0 .05" armature=".01"
 damping=".1"/><joint name="pitch" axis="0 1 0" pos="0 0 .05"/><geom type="capsule" fromto="0 0 0 .1 0 -.3" size=".03"/>
 <body name="second" pos=".1 0 -.3"><joint axis="0 0 1"/><geom type="box" size=".02 .03 .1" pos="0 .02 -.1"/>
  <body name="third" pos="0 0 -.2"><joint axis="1 1 0"/><geom type="box" size=".02 .03 .1" pos="0 0 -.1"/></body>
 </body></body></body></worldbody></mujoco>"""

BAR = '<inertial pos="{0} 0 {1}" mass="{2}" fullinertia=".01 .02 .013 .001 .002 -.001"/>'
OPEN_BARS = f"""<mujoco model="four-bar"><worldbody>
<body name="crank"><joint name="crank" axis="0 1 0"/>{BAR.format(0, 0.1, 1)}
 <body name="coupler" pos="0 0 .2"><joint name="coupler" axis="0 1 0"/>{BAR.format(0.2, 0, 1.5)}</body></body>
<body name="rocker" pos=".4 0 0"><joint name="rocker" axis="0 1 0"/>{BAR.format(0.05, 0.1, 0.8)}</body>
</worldbody></mujoco>"""
ALL = {
    "arm": ARM, "gripper": GRIPPER, "quadruped": QUADRUPED, "quadrotor": QUADROTOR, "chain": CHAIN, "bars": OPEN_BARS
}  # fmt: skip
