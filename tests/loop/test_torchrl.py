"""TorchRL's own losses, buffers and TensorDicts with the prior in them, against the facade on plain tensors."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch
from torch import nn

from esp_cli import Continuous, Field, Items, Kind, Symmetry, discrete_moves, layout

pytest.importorskip("torchrl", reason="needs TorchRL, of the extra torchrl")

from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.nn.distributions import NormalParamExtractor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import ProbabilisticActor, QMixer, QValueModule, TanhNormal
from torchrl.objectives import A2CLoss, ClipPPOLoss, DQNLoss, KLPENPPOLoss, ReinforceLoss, ValueEstimators
from torchrl.objectives.multiagent import QMixerLoss

from esp_cli.loop.torchrl import SymmetricCopies, SymmetricLoss

try:
    from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
except ImportError:  # not yet in the release that BenchMARL takes
    IPPOLoss = MAPPOLoss = None

SEEN = layout(Field("velocity", Kind.VECTOR), Field("others", Kind.VECTOR, 2, items=Items.OTHERS))
ROWS, AGENTS, WIDTH = 5, 3, 6
MOVES = discrete_moves(4)
FORCE = Continuous(layout(Field("force", Kind.VECTOR)))


def symmetry(group: str = "rot90", action: Any = MOVES, **choice: Any) -> Symmetry:
    return Symmetry(observation=SEEN, action=action, group=group, num_agents=AGENTS, **choice)


def rows(discrete: bool = True) -> TensorDict:
    generator = torch.Generator().manual_seed(0)

    def numbers(*shape: int) -> torch.Tensor:
        return torch.randn(ROWS, AGENTS, *shape, generator=generator)

    action = torch.randint(4, (ROWS, AGENTS), generator=generator) if discrete else numbers(2).tanh()
    agents = {"observation": numbers(WIDTH), "action": action, "log_prob": -numbers().abs()}
    agents |= {"advantage": numbers(1), "value_target": numbers(1), "logits": numbers(4)}
    ended = torch.zeros(ROWS, 1, dtype=torch.bool)
    later = {"agents": {"observation": numbers(WIDTH), "reward": numbers(1)}, "reward": numbers(1)[:, 0]}
    later |= {"done": ended, "terminated": ended}
    return TensorDict({"agents": agents, "next": later, "done": ended}, [ROWS])


def actor(discrete: bool = True) -> ProbabilisticActor:
    torch.manual_seed(0)
    seen, logits = [("agents", "observation")], [("agents", "logits")]
    if discrete:
        net: Any = TensorDictModule(nn.Linear(WIDTH, 4), seen, logits)
        kind: Any = torch.distributions.Categorical
        keys = {"logits": ("agents", "logits")}
    else:
        keys = {"loc": ("agents", "loc"), "scale": ("agents", "scale")}
        net = TensorDictModule(nn.Sequential(nn.Linear(WIDTH, 4), NormalParamExtractor()), seen, list(keys.values()))
        kind = TanhNormal
    return ProbabilisticActor(net, keys, [("agents", "action")], distribution_class=kind, return_log_prob=True)


def critic() -> TensorDictModule:
    torch.manual_seed(1)
    return TensorDictModule(nn.Linear(WIDTH, 1), [("agents", "observation")], [("agents", "state_value")])


def ppo(kind: Any, discrete: bool = True) -> Any:
    loss = kind(actor(discrete), critic(), normalize_advantage=False)
    keys = {name: ("agents", name) for name in ("action", "advantage", "value_target")}
    loss.set_keys(**keys, value=("agents", "state_value"), sample_log_prob=("agents", "log_prob"))
    return loss


KINDS = [ClipPPOLoss, MAPPOLoss, IPPOLoss]


def skip_missing(kind: Any) -> None:
    if kind is None:
        pytest.skip("this release of TorchRL has no MAPPOLoss and IPPOLoss")


def test_a_tensordict_is_copied_key_by_key() -> None:
    data = rows()
    both = symmetry("rot90*agents-1-2-0").augment_tensordict(data)
    obs, action, (log_prob, advantage) = symmetry("rot90*agents-1-2-0").augment(
        data["agents", "observation"],
        data["agents", "action"],
        per_agent=(data["agents", "log_prob"], data["agents", "advantage"]),
    )
    assert both.batch_size == (2 * ROWS,)
    agents = both["agents"]
    assert torch.equal(agents["observation"], obs)
    assert torch.equal(agents["action"], action)
    assert torch.equal(agents["log_prob"], log_prob)
    assert torch.equal(agents["advantage"], advantage)
    assert torch.equal(both["next", "reward"][ROWS:], data["next", "reward"])
    assert not torch.equal(both["next", "agents", "observation"][ROWS:], data["next", "agents", "observation"])
    assert "logits" not in agents, "what networks said is not carried over"
    assert data["agents", "logits"].shape == (ROWS, AGENTS, 4), "the original stays as it is"


def test_a_mask_of_actions_turns_with_the_actions() -> None:
    data = rows()
    data["agents", "action_mask"] = torch.tensor([True, False, False, True]).expand(ROWS, AGENTS, 4)
    both = symmetry().augment_tensordict(data)
    assert both["agents", "action_mask"][ROWS, 0].tolist() == [True, True, False, False], "right becomes up, down right"


def test_a_group_of_one_agent_may_have_an_agent_axis() -> None:
    alone = Symmetry(observation=layout(Field("velocity", Kind.VECTOR)), action=FORCE, group="rot90")
    obs, ended = torch.tensor([[[1.0, 0.0]]] * 4), torch.zeros(4, 1, dtype=torch.bool)
    data = TensorDict({"agents": {"observation": obs, "action": obs, "reward": obs[..., :1]}, "done": ended}, [4])
    both = alone.augment_tensordict(data)
    assert both["agents", "observation"][4:].tolist() == both["agents", "action"][4:].tolist() == [[[0.0, 1.0]]] * 4
    flat = alone.augment_tensordict(TensorDict({"observation": obs[:, 0], "action": obs[:, 0]}, [4]))
    assert flat["action"][4:].tolist() == [[0.0, 1.0]] * 4


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"hidden": torch.zeros(ROWS, AGENTS, 64)}, r"agents\.hidden .* a stored hidden state cannot be transformed"),
        (
            {"observation": torch.zeros(ROWS, AGENTS, 5)},
            r"agents\.observation .* rows of 5 numbers, but its layout has 6",
        ),
        ({"action": torch.full((ROWS, AGENTS), 4)}, r"agents\.action .* the action 4 is outside"),
    ],
)
def test_a_key_that_does_not_fit_is_named(change: dict[str, torch.Tensor], sentence: str) -> None:
    data = rows()
    data["agents"].update(change)
    with pytest.raises(ValueError, match=sentence):
        symmetry().augment_tensordict(data)


def test_a_key_of_the_role_drop_is_left_out() -> None:
    data = rows()
    data["agents", "hidden"] = torch.zeros(ROWS, AGENTS, 64)
    both = symmetry().augment_tensordict(data, {"hidden": "drop"})
    assert "hidden" in data["agents"]
    assert "hidden" not in both["agents"]
    assert both["agents", "observation"].shape[0] > ROWS


def test_a_role_that_there_is_not_is_refused() -> None:
    with pytest.raises(ValueError, match="advantage has the role 'number'; the roles are observation, state, action"):
        symmetry().augment_tensordict(rows(), {"advantage": "number"})


def test_short_ids_of_trajectories_stay_apart_and_one_step_has_copies() -> None:
    ids = torch.arange(ROWS, dtype=torch.int32)
    own, copied = symmetry().augment_tensordict(rows().set("traj_ids", ids))["traj_ids"].split(ROWS)
    assert torch.equal(own, ids.long())
    assert (copied < 0).all()
    alone = Symmetry(observation=layout(Field("velocity", Kind.VECTOR)), action=MOVES, group="rot90")
    step = TensorDict({"observation": torch.tensor([1.0, 2.0]), "action": torch.tensor(0)}, [])
    assert alone.augment_tensordict(step)["action"].tolist() == [0, 1], "right becomes up"


def test_a_tensordict_without_observations_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no key of the TensorDict is an observation .* it has pixels"):
        symmetry().augment_tensordict(TensorDict({"pixels": torch.zeros(ROWS, 3)}, [ROWS]))


def test_a_replay_buffer_samples_rows_with_their_copies() -> None:
    buffer = ReplayBuffer(storage=LazyTensorStorage(ROWS), batch_size=4, transform=SymmetricCopies(symmetry()))
    buffer.extend(rows())
    assert len(buffer) == ROWS
    sample = buffer.sample()
    assert sample.batch_size == (8,)
    velocity = sample["agents", "observation"][..., :2]
    assert torch.equal(velocity[4:, :, 0], -velocity[:4, :, 1])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("discrete", [True, False])
def test_the_loss_is_that_of_the_copied_rows_plus_the_consistency_terms(kind: Any, discrete: bool) -> None:
    skip_missing(kind)
    data, loss = rows(discrete), ppo(kind, discrete)
    action = MOVES if discrete else FORCE
    got = SymmetricLoss(loss, symmetry("d4", action, copies="all"), 0.5)(data.clone())
    again = symmetry("d4", action, copies="all")
    plain = loss(again.augment_tensordict(data))
    obs, bare = data["agents", "observation"], loss.actor_network
    with loss.actor_network_params.to_module(bare):
        policy_gap = again.policy_loss(
            lambda x: bare.get_dist(TensorDict({"agents": {"observation": x}}, [ROWS])), obs
        ).item()
    with loss.critic_network_params.to_module(loss.critic_network):
        value_gap = again.value_loss(
            lambda x: loss.critic_network(TensorDict({"agents": {"observation": x}}, [ROWS]))["agents", "state_value"],
            obs=obs,
        ).item()
    assert policy_gap > 0.01
    assert value_gap > 0.01
    assert got["policy_symmetry"].item() == pytest.approx(policy_gap, rel=1e-4)
    assert got["value_symmetry"].item() == pytest.approx(value_gap, rel=1e-4)
    assert got["loss_objective"].item() == pytest.approx(plain["loss_objective"].item() + 0.5 * policy_gap, rel=1e-4)
    assert got["loss_critic"].item() == pytest.approx(plain["loss_critic"].item() + 0.5 * value_gap, rel=1e-4)


def test_without_copies_the_loss_is_that_of_the_originals() -> None:
    data, loss = rows(), ppo(ClipPPOLoss)
    plain = loss(data.clone())
    assert (
        SymmetricLoss(loss, symmetry(), 0.0, augment=False)(data.clone())["loss_objective"] == plain["loss_objective"]
    )
    alone = SymmetricLoss(loss, symmetry(), 1e-9, augment=False)(data.clone())
    both = SymmetricLoss(loss, symmetry(), 0.0)(data.clone())
    assert alone["loss_objective"].item() == pytest.approx(plain["loss_objective"].item(), rel=1e-5)
    assert alone["policy_symmetry"].item() == pytest.approx(both["policy_symmetry"].item(), rel=1e-5)
    assert both["loss_objective"].item() != pytest.approx(plain["loss_objective"].item(), rel=1e-3)


def test_an_actor_of_a_way_of_its_own_is_refused() -> None:
    class Direct(ProbabilisticActor):
        def get_dist(self, tensordict: TensorDict) -> torch.distributions.Distribution:
            return self.build_dist_from_params(self.module[0](tensordict))

    loss = ppo(ClipPPOLoss)
    loss.actor_network.__class__ = Direct
    with pytest.raises(ValueError, match="Direct did not say its policy; give a ProbabilisticActor of one"):
        SymmetricLoss(loss, symmetry(), 0.1)(rows())


def mixer_loss() -> QMixerLoss:
    torch.manual_seed(0)
    q = TensorDictModule(nn.Linear(WIDTH, 4), [("agents", "observation")], [("agents", "action_value")])
    values = [("agents", name) for name in ("action", "action_value", "chosen_action_value")]
    chooser = QValueModule("categorical", action_value_key=values[1], out_keys=values, spec=None)
    mixer = TensorDictModule(
        QMixer(state_shape=(AGENTS, WIDTH), mixing_embed_dim=8, n_agents=AGENTS, device="cpu"),
        [("agents", "chosen_action_value"), ("agents", "observation")],
        ["chosen_action_value"],
    )
    loss = QMixerLoss(TensorDictSequential(q, chooser), mixer, action_space="categorical", delay_value=True)
    loss.set_keys(
        action_value=("agents", "action_value"),
        local_value=("agents", "chosen_action_value"),
        global_value="chosen_action_value",
        action=("agents", "action"),
    )
    loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
    return loss


def test_qmix_compares_the_mixed_value_of_actions_taken() -> None:
    data, loss = rows(), mixer_loss()
    both = symmetry().augment_tensordict(data)
    plain = loss(both)["loss"].item()
    with torch.no_grad(), loss.local_value_network_params.to_module(loss.local_value_network):
        said = loss.local_value_network(both.clone())
    taken = said["agents", "action_value"].gather(-1, both["agents", "action"].unsqueeze(-1))
    said["agents", "chosen_action_value"] = taken
    with torch.no_grad(), loss.mixer_network_params.to_module(loss.mixer_network):
        total = loss.mixer_network(said)["chosen_action_value"]
    gap = (total[:ROWS] - total[ROWS:]).square().mean().item()
    prioritised = data.clone()
    got = SymmetricLoss(loss, symmetry(), 0.5)(prioritised)
    assert gap > 1e-4
    assert got["value_symmetry"].item() == pytest.approx(gap, rel=1e-4)
    assert got["loss"].item() == pytest.approx(plain + 0.5 * gap, rel=1e-4)
    assert prioritised["td_error"].shape[0] == ROWS
    got["loss"].backward()


def test_a_loss_of_another_kind_is_refused() -> None:
    net = TensorDictModule(nn.Linear(WIDTH, 4), ["observation"], ["action_value"])
    module = TensorDictSequential(net, QValueModule("categorical", spec=None))
    with pytest.raises(ValueError, match="DQNLoss is not known; give ClipPPOLoss, MAPPOLoss, IPPOLoss, A2CLoss or QM"):
        SymmetricLoss(DQNLoss(module, action_space="categorical"), symmetry())
    for kind in (KLPENPPOLoss, ReinforceLoss):  # which have an actor and a critic too
        with pytest.raises(ValueError, match=f"{kind.__name__} is not known"):
            SymmetricLoss(kind(actor(), critic()), symmetry())
    with pytest.raises(ValueError, match="a sum over rows, but consistency is a mean; give it reduction='mean'"):
        SymmetricLoss(ClipPPOLoss(actor(), critic(), reduction="sum"), symmetry())


@pytest.mark.parametrize("shape", [[], [0]])
def test_data_without_rows_are_refused(shape: list[int]) -> None:
    with pytest.raises(ValueError, match=re.escape(f"the data have batch_size {shape}; give [B, ...] of one row")):
        SymmetricLoss(ppo(ClipPPOLoss), symmetry())(TensorDict({}, shape))


def test_a2c_estimates_advantages_that_are_missing() -> None:
    loss = A2CLoss(actor(), critic())
    keys = {name: ("agents", name) for name in ("action", "reward", "done", "terminated")}
    loss.set_keys(**keys, value=("agents", "state_value"), sample_log_prob=("agents", "log_prob"))
    data = rows().exclude(("agents", "advantage"), ("agents", "value_target"))
    for name in ("done", "terminated"):
        data["next", "agents", name] = torch.zeros(ROWS, AGENTS, 1, dtype=torch.bool)
    got = SymmetricLoss(loss, symmetry(), 0.5)(data.clone())
    alone = SymmetricLoss(loss, symmetry(), 0.5, augment=False)(data.clone())
    plain = loss(data.clone())
    assert got["value_symmetry"].item() > 1e-3
    assert alone["loss_critic"].item() == pytest.approx(
        plain["loss_critic"].item() + 0.5 * got["value_symmetry"].item(), rel=1e-4
    )
