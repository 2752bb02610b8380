"""A prior that fades, and the compass under which every problem is exactly symmetric."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from esp_cli.checking.measured import prepared
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.prior import SymmetryPrior
from esp_cli.prior.config import PriorConfig
from esp_cli.run import Run
from esp_cli.symmetry import build_transform, mirror, parse_elements, rotation, transform_set
from esp_cli.training.build import build_environment
from esp_cli.training.checkpoint import POLICY_FORMAT, load_checkpoint
from esp_cli.training.config import RunConfig, resolve_config
from esp_cli.training.run_folder import RunFolder
from esp_envs import make
from esp_envs.spec import joint_layout
from esp_envs.views import Compass, framed
from tests.cli.running import esp, refused
from tests.learning.golden import digest
from tests.prior.test_copies import SPACES, Squared, rows

_OFF_POLICY = "--set maddpg.num_envs=2 --set maddpg.warmup_episodes=2 --set maddpg.batch_episodes=4 --steps 300"
SMALL = {
    "mappo": "--set mappo.num_envs=8 --set mappo.num_epochs=3 --set mappo.num_minibatches=1 --steps 1200",
    "maddpg": f"--algo maddpg {_OFF_POLICY}",
    "qmix": f"--algo qmix {_OFF_POLICY.replace('maddpg', 'qmix')}",
}


def faded(progress: float, **choice: object) -> SymmetryPrior:
    prior = SymmetryPrior(PriorConfig(**{"transforms": "d4", "fade": 0.5, "consistency_coef": 0.5, **choice}), SPACES)
    prior.begin(progress)
    return prior


def generators(count: int = 2) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(count)]


@pytest.mark.parametrize(("progress", "strength"), [(0.0, 1.0), (0.125, 0.75), (0.25, 0.5), (0.5, 0.0), (0.9, 0.0)])
def test_the_strength_falls_linearly_to_0(progress: float, strength: float) -> None:
    assert faded(progress).strength == pytest.approx(strength)
    assert faded(progress, fade=0.0).strength == 1
    assert float(faded(progress).augmented_share(1)) == pytest.approx(strength / 2)


@pytest.mark.parametrize("choice", [{}, {"copies": "all"}, {"transforms": "rot90"}, {"transforms": "o2"}], ids=str)
def test_elements_stay_with_the_probability_that_the_strength_says(choice) -> None:
    spaces = make("navigation", 1, [0], {"actions": "continuous"}).spec
    prior = SymmetryPrior(PriorConfig(**{"transforms": "d4", "fade": 1.0, **choice}), spaces)
    prior.begin(0.7)
    own = generators()
    drawn = [g.elements for _ in range(150) for g in prior._draw(own)]
    moving = torch.tensor([[not element.is_identity for element in pair] for pair in drawn]).float()
    error = (0.3 * 0.7 / len(moving)) ** 0.5
    assert moving.mean(0) == pytest.approx(torch.full((2,), 0.3), abs=4 * error)


@pytest.mark.parametrize(
    ("certain", "strength", "expected", "share"),
    [
        (1.0, 1.0, {"rot90": 1 / 6, "rot180": 5 / 6, "flip-x": 0, "identity": 0}, 0.5),
        (1.0, 0.5, {"rot90": 1 / 11, "rot180": 10 / 11, "flip-x": 0, "identity": 0}, 0.5),
        (1.0, 0.0, {"rot90": 0, "rot180": 1, "flip-x": 0, "identity": 0}, 0.5),
        (0.6, 1.0, {"rot90": 0.15, "rot180": 0.45, "flip-x": 0, "identity": 0.4}, 0.3),
        (0.6, 0.5, {"rot90": 0.075, "rot180": 0.225, "flip-x": 0, "identity": 0.7}, 0.15),
    ],
)
def test_elements_are_drawn_by_their_weights_and_those_of_weight_1_do_not_fade(certain, strength, expected, share):
    weights = {"rot90": 0.2, "rot180": certain, "flip-x": 0.0}
    config = PriorConfig(transforms="rot90,rot180,flip-x", trust="measured", weights=weights, fade=1.0)
    prior = SymmetryPrior(config, make("navigation", 1, [0]).spec)
    prior.begin(1 - strength)
    own = generators(1)
    names = [prior._draw(own)[0].elements[0].name for _ in range(1500)]
    for name, chance in expected.items():
        error = (chance * (1 - chance) / 1500) ** 0.5
        assert names.count(name) / 1500 == pytest.approx(chance, abs=4 * error)
    assert float(prior.augmented_share(1)) == pytest.approx(share)


def test_auto_is_short_for_measured_weights_that_fade_and_what_a_user_chooses_wins() -> None:
    auto = PriorConfig.model_validate({"kind": "auto"})
    assert auto == PriorConfig(kind="esp", trust="measured", fade=0.5)
    assert PriorConfig.model_validate({"kind": "auto", "fade": 0.2, "transforms": "c4"}).fade == 0.2
    assert PriorConfig.model_validate(auto.model_dump()) == auto


def test_auto_weighs_all_of_d4_where_a_preset_has_less_and_nobody_chose() -> None:
    def transforms(**overrides: object) -> str:
        named = {f"prior.{name}": value for name, value in overrides.items()}
        return resolve_config("formation", overrides=named).prior.transforms

    assert (transforms(), transforms(kind="auto")) == ("c4", "d4")
    assert transforms(kind="auto", transforms="c2") == "c2"
    assert transforms(trust="measured", fade=0.5) == "c4", "written out, a preset's choice stays"


def test_weights_of_1_are_the_prior_as_it_is_bit_for_bit(tmp_path: Path) -> None:
    measured = ("--set", "prior.trust=measured")
    assert train_small(tmp_path / "b", "mappo") == train_small(tmp_path / "auto", "mappo", "--prior", "auto")
    config = json.loads((tmp_path / "auto" / "config.json").read_text())
    assert set(config["prior"]["weights"].values()) == {1.0}
    windy = ("--set", "task.wind=0.3")
    broken = train_small(tmp_path / "c", "mappo", *measured, *windy)
    assert broken != train_small(tmp_path / "d", "mappo", *windy)
    weights = json.loads((tmp_path / "c" / "config.json").read_text())["prior"]["weights"]
    assert weights["flip-x"] == 1
    assert weights["rot180"] < weights["rot90"] < 0.2
    assert weights["rot90"] == pytest.approx(math.exp(-8 * 0.285), abs=0.02), "off by 0.285 s.d. of the velocity"


@pytest.mark.parametrize("weights", [{}, {"rot90": 0.5}, {"rot90": 1.0, "rot180": 1.0, "flip-y": 0.5}], ids=str)
def test_weights_that_are_not_of_the_elements_are_refused(weights) -> None:
    config = PriorConfig(transforms="rot90,rot180", trust="measured", weights=weights)
    with pytest.raises(ValueError, match="does not weigh just these elements: rot90, rot180"):
        SymmetryPrior(config, make("navigation", 1, [0]).spec)


def test_a_sampled_group_cannot_be_weighed() -> None:
    settings = {"task.actions": "continuous", "prior.transforms": "o2", "prior.trust": "measured"}
    with pytest.raises(ValueError, match="'o2' is sampled"):
        prepared(resolve_config("navigation", overrides=settings))


def test_a_task_without_states_is_weighed_by_its_transitions(monkeypatch) -> None:
    monkeypatch.setattr("esp_envs.base.Environment.has", classmethod(lambda cls, method: False))

    def weights(wind):
        overrides = {"prior.trust": "measured", "prior.transforms": "c4,flip-x", "task.wind": wind}
        return prepared(resolve_config("navigation", overrides=overrides)).prior.weights

    clean = weights(0.0)
    assert set(clean.values()) <= {0.0, 1.0}, "none is broken; where transitions cannot tell, it is left out"
    assert 1.0 in clean.values()
    found = weights(0.31)
    assert found["flip-x"] in (0, 1)
    assert found["rot180"] == found["rot90"] == 0, "transitions show them broken"


def test_a_prior_of_no_strength_makes_no_copies_and_draws_nothing() -> None:
    own = generators()
    made = faded(0.5).copies(rows(), own)
    assert made.transforms == []
    assert made.loss_rows is made.originals
    assert made.penalty(value=torch.randn(2, 3, 1, 1)).value == 0
    assert all(torch.equal(g.get_state(), new.get_state()) for g, new in zip(own, generators(), strict=True))


def test_a_copy_by_the_identity_equals_its_original_and_costs_no_penalty() -> None:
    """Half strength, with a generator whose draws are known: seed 0 keeps rot90, seed 1 gets the identity."""
    prior = faded(0.25, transforms="rot90", copies="draw")
    own = generators(40)
    stays = [float(torch.rand((), generator=g)) < 0.5 for g in generators(40)]
    (transform,) = prior._draw(own)
    assert [not element.is_identity for element in transform.elements] == stays
    kept, gone = stays.index(True), stays.index(False)
    made = faded(0.25, transforms="rot90").copies(rows(), [generators(40)[kept], generators(40)[gone]])
    here, there = made.rows.obs.split(3, 1)
    assert not torch.equal(here[0], there[0])
    assert torch.equal(here[1], there[1])
    logits = torch.tensor([1.0, 0, 0, 0]).expand(2, 6, 1, 2, 4)
    values = torch.tensor([3.0, 3, 3, 3, 3, 3]).view(1, 6, 1, 1).expand(2, 6, 1, 1)
    assert made.penalty(policy=(Squared(), logits), value=values).value.tolist() == [0.5 * 2, 0.0]


@pytest.mark.parametrize("algorithm", SMALL)
def test_a_prior_that_never_fades_trains_as_ever_and_one_that_does_trains_otherwise(algorithm: str, tmp_path) -> None:
    def weights(name: str, *more: str) -> str:
        return train_small(tmp_path / name, algorithm, *more)

    plain = weights("plain")
    assert weights("fade-0", "--set", "prior.fade=0") == plain
    assert weights("fade-1", "--set", "prior.fade=1") != plain


def train_small(folder: Path, algorithm: str, *more: str) -> str:
    esp("train", "--task", "navigation", *SMALL[algorithm].split(), "--seeds", "2", "--out", folder, *more)
    return digest(load_checkpoint(folder / "policy.safetensors", POLICY_FORMAT)[0])


def worlds(num_envs: int = 16, **settings: object) -> Compass:
    return Compass(make("navigation", num_envs, [0, 1], settings), 0.5)


def test_the_compass_is_the_last_of_what_agents_and_critic_see() -> None:
    env, bare = worlds(), make("navigation", 16, [0, 1])
    seen, plain = env.reset(), bare.reset()
    assert torch.equal(seen.obs[..., :-4], plain.obs)
    assert torch.equal(seen.state[..., :-4], plain.state)
    for part in (seen.obs[..., -4:], seen.state[..., -4:]):
        assert torch.equal(part, torch.tensor([0.5, 0, 0, 0.5]).expand(part.shape))
    while (step := env.step(env.random_action())).final is None:
        pass
    assert step.final.obs.shape == step.next.obs.shape == seen.obs.shape
    assert env.spec.observation.fields[-1].name == "compass"


def test_the_compass_turns_with_every_element_and_no_two_elements_show_the_same() -> None:
    spec = framed(make("navigation", 1, [0], {"actions": "continuous"}).spec)
    frame = torch.zeros(1, 3, spec.observation.width)
    frame[..., -4:] = torch.tensor([1.0, 0, 0, 1])
    turned = build_transform([rotation(90)], spec).obs(frame)[0, 0, -4:]
    assert turned.tolist() == [0, 1, -1, 0]
    assert build_transform([mirror(0)], spec).obs(frame)[0, 0, -4:].tolist() == [1, 0, 0, -1]
    images = [tuple(build_transform([e], spec).obs(frame)[0, 0, -4:].tolist()) for e in parse_elements("d16", 3)]
    assert len(set(images)) == len(images) == 31


def test_a_compass_tells_directions_and_agents_apart_but_no_items() -> None:
    spec = replace(make("navigation", 1, [0]).spec, symmetry="d1", nearly="")
    for declared, transforms in (("d1*landmarks-3", "landmarks-3"), ("d1", "rot90"), ("d1", "d4*agents")):
        config = PriorConfig(transforms=transforms, compass=1.0)
        assert SymmetryPrior(config, framed(replace(spec, symmetry=declared))).transforms is not None
    with pytest.raises(ValueError, match="landmarks-3 cannot act on navigation"):
        SymmetryPrior(PriorConfig(transforms="landmarks-3", compass=1.0), framed(spec))


def test_with_the_compass_the_dynamics_commute_with_every_element_and_without_they_do_not() -> None:
    """Fit the change of velocity, linear in what an agent sees and does; hold the fit to transformed transitions."""
    env = Compass(make("navigation", 64, [0], {"actions": "continuous", "num_agents": 1, "wind": 0.3}), 1.0)
    here = env.reset().obs
    action = env.random_action()
    there = env.step(action).next.obs
    for compass, width in ((True, None), (False, -4)):
        spec = env.spec if compass else env.inner.spec
        seen, then = here[..., :width], there[..., :width]
        force = action / action.norm(dim=-1, keepdim=True).clamp_min(1.0)
        # the map that is equivariant where it can be: a constant force is a combination of the frame's axes
        constant = torch.tensor([[0.3 * 5], [0.0]])

        def predicted(obs, force, compass=compass, constant=constant):
            axes = obs[..., -4:].unflatten(-1, (2, 2)) if compass else torch.eye(2)
            return 0.75 * obs[..., :2] + 0.1 * (5 * force + (axes * constant).sum(-2))

        torch.testing.assert_close(predicted(seen, force), then[..., :2])
        worst = 0.0
        for element in transform_set("d8", spec).each():
            gap = predicted(element.obs(seen), element.action(force)) - element.obs(then)[..., :2]
            worst = max(worst, float(gap.abs().max()))
        assert worst < 1e-5 if compass else worst > 0.05


def test_exchanged_agents_keep_a_number_of_their_own() -> None:
    env = Compass(make("navigation", 2, [0]), 1.0, labels=True)
    seen = env.reset()
    assert seen.obs[0, 0, :, -1].tolist() == [-1, 0, 1]
    assert seen.state[0, 0, -3:].tolist() == [-1, 0, 1]
    (swap,) = transform_set("agents-1-0-2", env.spec).each()
    assert swap.obs(seen.obs)[0, 0, :, -1].tolist() == [0, -1, 1]
    assert swap.state(seen.state)[0, 0, -3:].tolist() == [0, -1, 1]
    config = {"prior.compass": 1.0}
    labelled = resolve_config("navigation", overrides=config | {"prior.transforms": "d4*agents"})
    assert [f.name for f in build_environment(labelled, 1, "x").spec.observation.fields][-2:] == ["compass", "label"]
    unlabelled = resolve_config("navigation", overrides=config)
    assert [f.name for f in build_environment(unlabelled, 1, "x").spec.observation.fields][-1] == "compass"


def test_a_state_of_all_observations_stays_one() -> None:
    spec = make("navigation", 1, [0]).spec
    joint = framed(type(spec)(**{**vars(spec), "state": joint_layout(spec.observation, 3)}))
    assert joint.state == joint_layout(joint.observation, 3)


def test_without_a_prior_there_is_no_compass() -> None:
    for overrides in ({"prior.kind": "none"}, {"prior.kind": "consistency", "prior.consistency_coef": 0}):
        config = resolve_config("navigation", overrides={"prior.compass": 1.0, **overrides})
        assert build_environment(config, 1, "x").spec == make("navigation", 1, [0]).spec


@pytest.mark.parametrize("trust", ["measured", "gate"])
def test_with_a_compass_nothing_is_left_to_measure(trust: str) -> None:
    config = resolve_config("navigation", overrides={"prior.trust": trust, "prior.compass": 1.0})
    with pytest.raises(ValueError, match="leave one of the two out"):
        prepared(config)


def test_a_gate_of_an_earlier_version_is_read_and_trains_no_more(tmp_path: Path) -> None:
    train_small(tmp_path / "run", "mappo")
    told = json.loads((tmp_path / "run" / "config.json").read_text())
    told["prior"] |= {"trust": "gate", "weights": {"rot90": 0.5}}
    RunFolder.create(tmp_path / "old", {name: told[name] for name in RunConfig.model_fields})
    assert "prior.trust=gate can no longer be trained" in refused("train", "--resume", tmp_path / "old")
    shutil.copy(tmp_path / "run" / "policy.safetensors", tmp_path / "old")
    assert Run(tmp_path / "old").config.prior.trust == "gate"
    assert Run(tmp_path / "old").evaluate(2).episodes == 2


def test_a_policy_with_a_compass_is_evaluated_drawn_and_exported_as_any_other(tmp_path: Path) -> None:
    train_small(tmp_path / "run", "mappo", "--set", "prior.compass=1")
    assert TrainedPolicy.read(tmp_path / "run").spec.observation.width == 18
    esp("eval", tmp_path / "run", "--episodes", "4")
    esp("export", tmp_path / "run", "-f", "numpy", "-o", tmp_path / "out")
    assert "compass" in (tmp_path / "out" / "policy.json").read_text()
