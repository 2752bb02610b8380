"""Small robots, each an MJCF text: what their mirrors do is worked out by hand beside them."""

from collections.abc import Sequence


def _leg(side: str, y: float, pitch: str, yaw: str) -> str:
    return f"""
    <body name="{side}_thigh" pos="0.02 {y} -0.1">
      <joint name="{side}_roll" axis="1 0 0" range="{"-10 60" if y > 0 else "-60 10"}"/>
      <joint name="{side}_pitch" axis="{pitch}" range="{"-100 30" if y > 0 else "-30 100"}"/>
      <geom type="capsule" fromto="0 0 0 0.01 0 -0.3" size="0.04"/>
      <body name="{side}_shin" pos="0.01 0 -0.3">
        <joint name="{side}_knee" axis="0 1 0" range="0 120" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03"/>
        <body name="{side}_foot" pos="0 0 -0.3">
          <joint name="{side}_yaw" axis="{yaw}" range="-40 40"/>
          <geom type="box" size="0.1 0.04 0.02" pos="0.03 0 0"/>
        </body>
      </body>
    </body>"""


def biped(right_pitch: str = "0 -1 0", right_y: float = -0.1, extra: str = "", feet: str = "0 0 -1") -> str:
    """Return two legs and a waist; axes of the right leg are not those of the left.

    Flip-x sends an axis (x, y, z) of a turn to (-x, y, -z). Roll about +x on both sides: sign -1. Pitch about +y left
    and -y right: -1. Knee about +y on both: +1. Yaw about +z left and -z right: +1. The waist turns about z: -1.
    """
    return f"""
<mujoco model="biped"><worldbody><geom type="plane" size="5 5 1"/>
  <body name="pelvis" pos="0 0 1"><freejoint name="root"/>
    <geom type="box" size="0.08 0.12 0.08"/>
    <body name="chest" pos="0 0 0.1"><joint name="waist" axis="0 0 1" range="-60 60"/>
      <geom type="box" size="0.07 0.14 0.15" pos="0.01 0 0.15"/></body>
    {_leg("left", 0.1, "0 1 0", "0 0 1")}{_leg("right", right_y, right_pitch, feet)}{extra}
  </body></worldbody>
  <actuator><position name="a_waist" joint="waist" kp="20"/>
    <motor name="a_left_pitch" joint="left_pitch" gear="10"/>
    <motor name="a_right_pitch" joint="right_pitch" gear="-10"/>
    <motor name="a_left_knee" joint="left_knee"/><motor name="a_right_knee" joint="right_knee"/></actuator>
</mujoco>"""


BIPED_JOINTS = {
    "waist": "-waist",
    "left_roll": "-right_roll",
    "left_pitch": "-right_pitch",
    "left_knee": "right_knee",
    "left_yaw": "right_yaw",
    "right_roll": "-left_roll",
    "right_pitch": "-left_pitch",
    "right_knee": "left_knee",
    "right_yaw": "left_yaw",
}


def legged(places: Sequence[tuple[float, float, float]], free: bool = True) -> str:
    """Return a round trunk with a leg at each (x, y, degrees): hips turn about z, knees about the leg's own left."""
    legs = "".join(
        f'<body name="leg{i}" pos="{x} {y} 0" euler="0 0 {turn}"><joint name="hip{i}" axis="0 0 1" range="-30 30"/>'
        f'<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03"/>'
        f'<body name="shin{i}" pos="0.2 0 0"><joint name="knee{i}" axis="0 1 0" range="20 100"/>'
        f'<geom type="capsule" fromto="0 0 0 0.2 0 -0.05" size="0.02"/></body></body>'
        for i, (x, y, turn) in enumerate(places)
    )
    motors = "".join(f'<motor joint="{part}{i}"/>' for i in range(len(places)) for part in ("hip", "knee"))
    return (
        f'<mujoco><worldbody><geom type="plane" size="5 5 1"/><body name="trunk" pos="0 0 1">'
        f'{"<freejoint/>" if free else ""}<geom type="cylinder" size="0.15 0.05"/>{legs}</body></worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


QUADRUPED = legged([(0.2, 0.1, 30), (0.2, -0.1, -30), (-0.2, 0.1, 150), (-0.2, -0.1, -150)])
"""Front left, front right, back left, back right: left-right, front-back and their product."""
