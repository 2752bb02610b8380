"""Action spaces of made-up tasks."""

from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Continuous, Discrete, Field, Kind, layout

FOUR_DIRECTIONS = Discrete(Kind.VECTOR, ((0.0, 0.0), LEFT, RIGHT, DOWN, UP), ("stay", "left", "right", "down", "up"))
WHEEL_PAIRS = Discrete(
    Kind.WHEELS, ((0.0, 0.0), (1.0, 1.0), (1.0, -1.0), (-1.0, 1.0)), ("stop", "forward", "spin-right", "spin-left")
)
FORCE = Continuous(layout(Field("force", Kind.VECTOR)))
WHEELS = Continuous(layout(Field("wheels", Kind.WHEELS)))
EVERYTHING = Continuous(
    layout(Field("force", Kind.VECTOR), Field("wheels", Kind.WHEELS), Field("spin", Kind.PSEUDOSCALAR))
)
