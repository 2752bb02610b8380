"""Made-up tasks that hold every field kind, so that the mathematics is tested apart from any real task."""

from collections.abc import Callable

import pytest
import torch

from esp_envs.spec import Field, Items, Kind, TaskSpec, joint_layout, layout
from tests.symmetry.toy_actions import FOUR_DIRECTIONS

MakeSpec = Callable[..., TaskSpec]


@pytest.fixture(scope="session")
def make_spec() -> MakeSpec:
    def make(
        num_agents: int = 3, action=FOUR_DIRECTIONS, symmetry: str = "o2*agents", joint_state: bool = False
    ) -> TaskSpec:
        observation = layout(
            Field("velocity", Kind.VECTOR),
            Field("battery", Kind.SCALAR),
            Field("turning_rate", Kind.PSEUDOSCALAR),
            Field("wheels", Kind.WHEELS),
            Field("landmarks", Kind.VECTOR, 2),
            Field("others", Kind.VECTOR, num_agents - 1, items=Items.OTHERS),
            Field("tags", Kind.SCALAR, num_agents, items=Items.AGENTS),
        )
        state = layout(
            Field("positions", Kind.VECTOR, num_agents, items=Items.AGENTS),
            Field("landmarks", Kind.VECTOR, 2),
            Field("turning_rates", Kind.PSEUDOSCALAR, num_agents, items=Items.AGENTS),
        )
        return TaskSpec(
            name="toy",
            version=1,
            convention="none",
            num_agents=num_agents,
            horizon=25,
            observation=observation,
            state=joint_layout(observation, num_agents) if joint_state else state,
            action=action,
            symmetry=symmetry,
        )

    return make


@pytest.fixture
def generators() -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in (3, 4, 5)]
