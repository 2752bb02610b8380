"""The hyperparameters of MAPPO."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from pydantic import Field

from esp_cli.algorithms.learner import LearnerConfig
from esp_cli.networks.contract import NetworkConfig
from esp_cli.networks.io_spec import Reads
from esp_envs.spec import TaskSpec


class MappoConfig(LearnerConfig):
    """Hyperparameters; every default stands here and nowhere else."""

    num_envs: int = Field(32, ge=1, description="worlds per seed; MAPPO paper on MPE: 128")
    num_steps: int = Field(25, ge=1, description="steps per world and update")
    num_epochs: int = Field(10, ge=1, le=1000, description="passes over a rollout")
    num_minibatches: int = Field(4, ge=1, le=10_000, description="gradient steps per pass; paper: 1")
    learning_rate: float = Field(1e-3, gt=0, description="of Adam, for actor and critic; paper: 7e-4")
    anneal_learning_rate: bool = Field(True, description="linearly to 0 over the run")
    adam_epsilon: float = Field(1e-5, gt=0, description="Adam's epsilon")
    max_grad_norm: float = Field(10.0, gt=0, description="per seed; actor and critic apart")
    gamma: float = Field(0.99, ge=0, le=1, description="discount")
    gae_lambda: float = Field(0.95, ge=0, le=1, description="lambda of generalised advantage estimation")
    clip_epsilon: float = Field(0.2, gt=0, description="range of the ratio's clip, and of the value's")
    clip_value: bool = Field(False, description="MAPPO paper: on; ours off, it slows learning badly")
    huber_delta: float = Field(10.0, gt=0, description="where the value loss becomes linear, in normalised units")
    value_coef: float = Field(1.0, gt=0, description="weight of the value loss")
    entropy_coef: float = Field(0.01, ge=0, description="weight of the entropy bonus")
    anneal_entropy: bool = Field(True, description="linearly to 0 over the run")
    bootstrap_truncated: bool = Field(True, description="value the final state where the horizon cuts an episode")
    value_decay: float = Field(0.99, gt=0, lt=1, description="of the value normaliser; MAPPO paper: 0.99999")
    critic_input: Reads = Field(
        "observations",
        description="the task's global state, all agents' observations in a row, or each agent's own observation",
    )
    critic_activation: Literal["relu", "tanh"] = Field("relu", description="the actor's is network.activation")
    truncation: int = Field(10, ge=0, description="recurrent networks: steps through which gradients flow")
    chunk_steps: int = Field(8000, ge=1, description="environment steps, over all seeds, of a forward pass; speed only")

    def without_effect(self, network: NetworkConfig, spec: Callable[[], TaskSpec]) -> frozenset[str]:
        idle = set() if network.recurrent else {"truncation"}
        if network.with_activation("relu") == network.with_activation("tanh"):
            idle.add("critic_activation")
        return frozenset(idle)
