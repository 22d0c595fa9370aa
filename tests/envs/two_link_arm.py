"""A robot on a fixed base, whose motors have ranges of their own and whose shoulder turns for ever."""

TWO_LINK_ARM = """
<mujoco><option timestep=".01"/>
  <worldbody><body name="upper">
    <joint name="shoulder" axis="0 0 1" damping=".1"/>
    <geom name="upper" type="capsule" fromto="0 0 0 .5 0 0" size=".03"/>
    <body name="lower" pos=".5 0 0">
      <joint name="elbow" axis="0 0 1" range="-150 150" damping=".1"/>
      <geom name="lower" type="capsule" fromto="0 0 0 .4 0 0" size=".03"/>
    </body>
  </body></worldbody>
  <actuator><motor joint="shoulder" gear="5" ctrlrange="-2 2"/><motor joint="elbow" ctrlrange="0 3"/></actuator>
</mujoco>
"""
