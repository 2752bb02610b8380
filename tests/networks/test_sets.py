"""Networks over sets: neither order nor number of like things matters, by torch and by kernels."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from esp_cli.networks.build import build_network
from esp_cli.networks.contract import IoSpec
from esp_cli.networks.kernels.sets import PooledPass, compiled_distances
from esp_cli.networks.perceptron import passed
from esp_cli.networks.plain import MlpConfig
from esp_cli.networks.set_equivariant import SetEquivariantConfig
from esp_cli.networks.set_features import Embedding, Rows, distances_among
from esp_cli.networks.sets import SetConfig
from esp_cli.training.build import build_learner, generators
from esp_cli.training.config import resolve_config
from esp_envs import Discrete, Field, Items, Kind, Spaces, UserError, layout, make
from esp_envs.mpe.task import FORCE
from tests.networks.kernels.compiler import assert_same_bits_alone_and_for_any_threads, needs_compiler

CLOSE = {"atol": 1e-5, "rtol": 1e-5}


def scene(worlds=6, **settings):
    env = make("navigation", worlds, [0, 1], settings)
    observation = env.reset()
    for _ in range(3):
        observation = env.step(env.random_action()).next
    return env.spec, observation


def network(spec, reads="own", config=None, seeds=(0, 1)):
    values = None if reads == "own" else (1 if spec.shared_reward else spec.num_agents)
    io = IoSpec(spec, reads, values)
    outputs = spec.action.count if values is None else values
    built = build_network(generators(seeds, "x"), io.layout.width, outputs, config or SetConfig(), 1.0, io)
    rng = torch.Generator().manual_seed(5)
    with torch.no_grad():  # so that nothing holds by the way it begins
        for p in built.parameters():
            p.add_(torch.randn(p.shape, generator=rng) * 0.1)
    return built


def test_distances_by_hand():
    """Landmarks at (3, 4) and (0, 1), one other agent at (0, -1)."""
    landmarks, others = torch.tensor([[[[3.0, 4.0], [0.0, 1.0]]]]), torch.tensor([[[[0.0, -1.0]]]])
    of_landmarks, of_others = distances_among([landmarks, others])
    apart = math.sqrt(18)  # (3, 4) to (0, 1)
    expected = [[5.0, apart, math.sqrt(34)], [1.0, apart, 2.0]]
    torch.testing.assert_close(of_landmarks[0, 0], torch.tensor(expected))
    # there is no other other: twice the largest distance
    torch.testing.assert_close(of_others[0, 0], torch.tensor([[1.0, 2.0, 10.0]]))


@needs_compiler
def test_kernels_equal_torch():
    rng = torch.Generator().manual_seed(0)
    for sizes in ((3, 2), (1, 1), (1, 5, 4)):
        places = [torch.randn(2, 37, size, 2, generator=rng) for size in sizes]
        for ours, theirs in zip(compiled_distances(places), distances_among(places), strict=True):
            torch.testing.assert_close(ours, theirs, **CLOSE)


@needs_compiler
@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize(("rows", "things"), [(700, 3), (19, 5), (3, 300), (7, 1)])
def test_a_pool_by_the_kernel_equals_that_by_torch(activation, rows, things):
    rng, config = torch.Generator().manual_seed(0), SetConfig(activation=activation, width=20)
    ours, theirs = (
        Embedding(generators([0, 1], "x"), (7, 33, 20), config.model_copy(update={"compiled": compiled}))
        for compiled in (True, False)
    )
    theirs.load_state_dict(ours.state_dict())
    parts = [torch.randn(2, rows, things, 4, generator=rng), torch.randn(2, rows, 1, 3, generator=rng)]
    parts = [part.requires_grad_() for part in parts]
    given = [parts[0], parts[1].expand(-1, -1, things, -1)]
    both = zip(ours.pooled(*given, each=True), theirs.pooled(*given, each=True), strict=True)
    slopes = [torch.randn(2, rows, 40, generator=rng), torch.randn(2, rows, things, 20, generator=rng)]
    sums = [0, 0]
    for (here, there), slope in zip(both, slopes, strict=True):
        torch.testing.assert_close(here, there, **CLOSE)
        sums = [sums[0] + (here * slope).sum(), sums[1] + (there * slope).sum()]
    by_ours = torch.autograd.grad(sums[0], [*ours.parameters(), *parts])
    by_theirs = torch.autograd.grad(sums[1], [*theirs.parameters(), *parts])
    for here, there in zip(by_ours, by_theirs, strict=True):
        torch.testing.assert_close(here, there, atol=1e-3, rtol=1e-4)
    with torch.no_grad():
        assert torch.equal(ours.pooled(*given)[0], ours.pooled(*given, each=True)[0])


@needs_compiler
def test_a_pool_by_hand_and_the_first_of_equal_maxima_takes_the_gradient():
    things = torch.tensor([[[[1.0, 4.0], [3.0, 4.0]]]], requires_grad=True)
    pooled = passed(partial(PooledPass, "relu", False), [things], [torch.eye(2)[None], torch.zeros(1, 1, 2)])
    assert pooled.flatten().tolist() == [2.0, 4.0, 3.0, 4.0]
    pooled.backward(torch.tensor([[[10.0, 20.0, 1.0, 2.0]]]))
    assert things.grad.flatten().tolist() == [5.0, 12.0, 6.0, 10.0]


@needs_compiler
@pytest.mark.parametrize("reads", ["own", "state", "observations"])
@pytest.mark.parametrize("settings", [{}, {"convention": "pettingzoo"}])
def test_compiled_networks_equal_those_by_torch(reads, settings):
    spec, _ = scene(**settings)
    kernel, plain = network(spec, reads, SetConfig(compiled=True)), network(spec, reads, SetConfig(compiled=False))
    x = torch.randn(2, 40, IoSpec(spec, reads).layout.width, generator=torch.Generator().manual_seed(1))
    ours, theirs = kernel(x), plain(x)
    torch.testing.assert_close(ours, theirs, **CLOSE)
    slope = torch.randn_like(ours)
    by_ours = torch.autograd.grad(ours, list(kernel.parameters()), slope)
    by_theirs = torch.autograd.grad(theirs, list(plain.parameters()), slope)
    for here, there in zip(by_ours, by_theirs, strict=True):
        torch.testing.assert_close(here, there, atol=1e-4, rtol=1e-4)


def reordered(spec, obs, name, order):
    """Return observations in which the items of one field have changed places."""
    where, out = spec.observation.slices()[name], obs.clone()
    out[..., where] = obs[..., where].unflatten(-1, (len(order), -1))[..., order, :].flatten(-2)
    return out


@pytest.mark.parametrize(
    ("config", "holds"), [(SetConfig(), True), (SetEquivariantConfig(), True), (MlpConfig(), False)]
)
@pytest.mark.parametrize(("field", "order"), [("landmarks", [2, 0, 1]), ("others", [1, 0])])
def test_the_order_of_like_things_changes_nothing(config, holds, field, order):
    spec, seen = scene()
    policy = network(spec, config=config)
    rows = seen.obs.flatten(1, 2)
    gap = (policy(rows) - policy(reordered(spec, rows, field, order))).abs().amax()
    assert bool(gap < 1e-5) is holds


def test_fields_of_a_family_change_places_together_or_not_at_all():
    seen = layout(
        Field("others", Kind.VECTOR, 2, items=Items.OTHERS), Field("load", Kind.SCALAR, 2, items=Items.OTHERS)
    )
    moves = Discrete(Kind.VECTOR, ((1.0, 0.0), (-1.0, 0.0)), ("right", "left"))
    spec = Spaces(num_agents=3, observation=seen, state=seen, action=moves, symmetry="d1")
    policy = network(spec)
    x = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).expand(2, 1, -1)
    together = torch.tensor([3.0, 4.0, 1.0, 2.0, 6.0, 5.0]).expand(2, 1, -1)
    places_alone = torch.tensor([3.0, 4.0, 1.0, 2.0, 5.0, 6.0]).expand(2, 1, -1)
    torch.testing.assert_close(policy(x), policy(together), **CLOSE)
    assert (policy(x) - policy(places_alone)).abs().amax() > 1e-3


@pytest.mark.parametrize(("settings", "holds"), [({}, True), ({"mud": 0.5}, False)])
@pytest.mark.parametrize("reads", ["own", "state"])
def test_places_are_no_input_where_a_task_does_not_change_when_it_is_shifted(reads, settings, holds):
    spec, seen = scene(**settings)
    built = network(spec, reads)
    row = seen.obs.flatten(1, 2) if reads == "own" else seen.state
    moved = row.clone()
    for part in (spec.observation if reads == "own" else spec.state).fields:
        if part.is_point:
            where = IoSpec(spec, reads).layout.slices()[part.name]
            moved[..., where] += torch.tensor([0.5, -2.0]).repeat(part.count)
    assert bool((built(row) - built(moved)).abs().amax() < 1e-4) is holds


@pytest.mark.parametrize("reads", ["state", "observations"])
def test_values_of_agents_with_rewards_of_their_own_change_places_with_them(reads):
    spec, seen = scene(convention="pettingzoo")
    critic, order = network(spec, reads), [2, 0, 1]
    row = seen.state if reads == "state" else seen.obs.flatten(2)
    values = critic(row)
    assert values.shape[-1] == 3
    assert (values - values[..., :1]).abs().amax() > 1e-3
    torch.testing.assert_close(critic(exchanged(spec, row, reads, order)), values[..., order], **CLOSE)


@pytest.mark.parametrize("reads", ["own", "state", "observations"])
def test_weights_know_no_count(reads):
    few, many = network(scene()[0], reads), network(scene(num_agents=6, num_landmarks=4)[0], reads)
    assert {n: p.shape for n, p in few.named_parameters()} == {n: p.shape for n, p in many.named_parameters()}


def test_values_are_read_off_the_agents_though_other_things_are_as_many_and_stand_first():
    things = Field("landmarks", Kind.VECTOR, 3)
    agents = Field("place", Kind.VECTOR, 3, items=Items.AGENTS, family="robots")
    state = layout(replace(things, family="landmarks"), agents)
    spec = replace(make("navigation", 1, [0]).spec, state=state, shared_reward=False)
    x = torch.randn(2, 5, 12, generator=torch.Generator().manual_seed(0))
    swapped = torch.cat([x[..., :6], x[..., 8:10], x[..., 6:8], x[..., 10:]], -1)
    value = network(spec, "state")
    torch.testing.assert_close(value(swapped), value(x)[..., [1, 0, 2]], **CLOSE)
    with pytest.raises(UserError, match="does not say which numbers are whose"):
        network(replace(spec, state=layout(replace(things, family="landmarks"))), "state")


def test_one_looks_at_the_nearest_alone():
    spec, seen = scene(num_agents=5)
    near, all_of_them = network(spec, config=SetConfig(near=2)), network(spec)
    rows = seen.obs.flatten(1, 2)
    landmarks = rows[..., spec.observation.slices()["landmarks"]].unflatten(-1, (5, 2))
    farthest = landmarks.norm(dim=-1).argmax(-1)
    other = rows.clone()
    where = spec.observation.slices()["landmarks"].start + 2 * farthest
    for k in (0, 1):
        other.scatter_(-1, (where + k).unsqueeze(-1), rows.gather(-1, (where + k).unsqueeze(-1)) * 1.5)
    torch.testing.assert_close(near(rows), near(other), **CLOSE)
    assert (all_of_them(rows) - all_of_them(other)).abs().amax() > 1e-3
    torch.testing.assert_close(network(spec, config=SetConfig(near=5))(rows), all_of_them(rows), **CLOSE)


@pytest.mark.parametrize("shifts", [False, True])
def test_the_nearest_of_things_that_are_points_are_nearest_to_the_reader(shifts):
    """It stands at (5, 0): the wall at (6, 0) is near, that at (1, 0) is far, though it is nearer to the origin."""
    walls = Field("walls", Kind.VECTOR, 2, family="walls", is_point=True)
    rows = Rows(layout(Field("place", Kind.VECTOR, is_point=True), walls), shifts, 1, False)
    x = torch.tensor([5.0, 0.0, 1.0, 0.0, 6.0, 0.0]).view(1, 1, -1)
    own, (near,) = rows.numbers(x)
    assert (near - own.unsqueeze(2)).flatten().tolist() == [1.0, 0.0]
    ways = Field("walls", Kind.VECTOR, 2, family="walls")
    _, (near,) = Rows(layout(Field("place", Kind.VECTOR, is_point=True), ways), False, 1, False).numbers(x)
    assert near.flatten().tolist() == [1.0, 0.0], "the control: a way is as long as it is"


def test_an_observation_without_like_things_is_refused():
    spec = scene()[0]
    own = layout(*(f for f in spec.observation.fields if not f.family_name))
    lonely = Spaces(num_agents=1, observation=own, state=spec.state, action=spec.action, symmetry="d4")
    with pytest.raises(UserError, match="the task shows none; say which fields are some"):
        network(lonely)


@pytest.mark.parametrize("name", ["keys", "a.b"])
def test_things_whose_name_no_weight_can_have_are_refused(name):
    spec = scene()[0]
    seen = layout(*(f for f in spec.observation.fields if not f.family_name), Field("x", Kind.VECTOR, 2, family=name))
    spaces = Spaces(num_agents=1, observation=seen, state=spec.state, action=spec.action, symmetry="d4")
    with pytest.raises(UserError, match=f"cannot have things named '{name}'; give this field another name"):
        network(spaces)


def test_wide_own_numbers_are_embedded_once():
    spec = make("wildlife", 2, [0]).spec
    assert Rows(spec.observation, False, 0, False).num_own > 32
    assert network(spec).features.encoder.num_own == 32


@needs_compiler
def test_a_seed_gets_the_same_bits_alone_and_with_any_number_of_threads():
    places, things = [torch.randn(3, 700, 4, 2), torch.randn(3, 700, 2, 2)], torch.randn(3, 700, 4, 16)
    weights = [torch.randn(3, 16, 8), torch.randn(3, 1, 8)]

    def results(seeds):
        leaves = [w[seeds].clone().requires_grad_() for w in weights]
        pooled = passed(partial(PooledPass, "tanh", False), [things[seeds]], leaves)
        slopes = torch.autograd.grad(pooled.square().sum(), leaves)
        return [*compiled_distances([p[seeds] for p in places]), pooled.detach(), *slopes]

    assert_same_bits_alone_and_for_any_threads(results, 3)


def joint(spec, build, reads):
    module = build(generators([0, 1], "x"), IoSpec(spec, reads))
    rng = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for p in module.parameters():
            p.add_(torch.randn(p.shape, generator=rng) * 0.1)
    return module


def exchanged(spec, seen, reads, order):
    """Return observations end to end, or states, in which agents have changed places."""
    moved = seen.clone()
    agents = lambda x: x.unflatten(-1, (3, -1))[..., order, :].flatten(-2)  # noqa: E731
    if reads == "observations":
        return agents(seen)  # the others of each have another order then too, which changes nothing
    for name in ("velocity", "position"):
        where = spec.state.slices()[name]
        moved[..., where] = agents(seen[..., where])
    return moved


@pytest.mark.parametrize("reads", ["state", "observations"])
def test_a_mixer_rises_with_every_value_and_knows_no_order_of_agents(reads):
    spec, scene_ = scene()
    seen = scene_.state if reads == "state" else scene_.obs.flatten(2)
    rows = torch.cat([seen, torch.rand(*seen.shape[:2], 1)], -1)
    mixer = joint(spec, lambda g, io: SetConfig().mixer(g, io, 8, 1), reads)
    values = torch.randn(2, 6, 3, requires_grad=True)
    total = mixer(values, rows)
    (slope,) = torch.autograd.grad(total.sum(), values)
    assert total.shape == (2, 6)
    assert (slope >= 0).all()
    assert (slope > 0).any()
    order = [2, 0, 1]
    moved = torch.cat([exchanged(spec, seen, reads, order), rows[..., -1:]], -1)
    torch.testing.assert_close(mixer(values[..., order], moved), total, **CLOSE)
    assert (mixer(values[..., order], rows) - total).abs().amax() > 1e-4, "negative control: values alone"


@pytest.mark.parametrize("reads", ["state", "observations"])
def test_a_critic_of_pairs_knows_no_order_of_agents_but_whose_action_is_whose(reads):
    spec, scene_ = scene()
    seen, action = scene_.state if reads == "state" else scene_.obs.flatten(2), torch.randn(2, 6, 15)
    critic = joint(spec, lambda g, io: SetConfig().joint_critic(g, io, 5, 0), reads)
    value, order = critic(seen, action), [2, 0, 1]
    acts = action.unflatten(-1, (3, 5))[..., order, :].flatten(-2)
    torch.testing.assert_close(critic(exchanged(spec, seen, reads, order), acts), value, **CLOSE)
    assert (critic(seen, acts) - value).abs().amax() > 1e-4, "negative control: actions alone"
    more = joint(scene(num_agents=5)[0], lambda g, io: SetConfig().joint_critic(g, io, 5, 0), reads)
    assert {n: p.shape for n, p in more.named_parameters()} == {n: p.shape for n, p in critic.named_parameters()}


@pytest.mark.parametrize("settings", [{}, {"maddpg.actor_actions": "own"}, {"maddpg.actor_gradient": "expected"}])
def test_maddpg_learns_with_a_critic_of_pairs(settings):
    learner = build_learner(
        resolve_config("navigation", "maddpg", overrides={"network.name": "set", **OFF, **settings})
    )
    before = {n: p.clone() for n, p in learner.critic.named_parameters()}
    acting = {n: p.clone() for n, p in learner.policy.named_parameters()}
    for _ in range(3):
        assert bool(learner.iterate(0.5).finite.all())
    assert all(not torch.equal(p, before[n]) for n, p in learner.critic.named_parameters() if p.dim() == 3)
    assert any(not torch.equal(p, acting[n]) for n, p in learner.policy.named_parameters())


def test_qmix_learns_with_a_mixer_over_a_set():
    config = {"network.name": "set", **{name.replace("maddpg", "qmix"): value for name, value in OFF.items()}}
    learner = build_learner(resolve_config("navigation", "qmix", overrides=config))
    before = {n: p.clone() for n, p in learner.mixer.named_parameters()}
    for _ in range(3):
        assert bool(learner.iterate(0.5).finite.all())
    assert any(not torch.equal(p, before[n]) for n, p in learner.mixer.named_parameters())


@needs_compiler
@pytest.mark.parametrize("reads", ["state", "observations"])
@pytest.mark.parametrize(
    "network",
    [{"name": "set"}, {"name": "set", "memory": True}, {"name": "set-equivariant"}],
    ids=["set", "memory", "equivariant"],
)
def test_mappo_with_compiled_sets_learns_as_by_torch(network, reads):
    def trained(compiled):
        small = {"mappo.num_envs": 4, "mappo.num_epochs": 2, "mappo.num_minibatches": 2, "mappo.critic_input": reads}
        chosen = {f"network.{name}": value for name, value in network.items()} | {"network.compiled": compiled}
        learner = build_learner(resolve_config("navigation", seeds=[0, 1], overrides=chosen | small))
        for _ in range(2):
            assert bool(learner.iterate(0.5).finite.all())
        return {n: p for n, p in learner.state_dict().items() if n.startswith(("policy", "critic")) and p.dim() == 3}

    kernel, plain = trained(compiled=True), trained(compiled=False)
    assert kernel.keys() == plain.keys()
    for n, p in kernel.items():
        torch.testing.assert_close(p, plain[n], atol=1e-4, rtol=1e-4, msg=n)


OFF = {"maddpg.num_envs": 4, "maddpg.batch_episodes": 4, "maddpg.warmup_episodes": 2}


def turned(spec, x, element, reads):
    """Apply a turn or mirror of the plane, a matrix [2, 2], to every vector of rows."""
    out = x.clone()
    for field, where in zip(spec.fields, spec.slices().values(), strict=True):
        assert field.kind == Kind.VECTOR
        out[..., where] = (x[..., where].unflatten(-1, (-1, 2)) @ element.T).flatten(-2)
    return out


TURNS = {
    "rot90": torch.tensor([[0.0, -1.0], [1.0, 0.0]]),
    "flip": torch.tensor([[-1.0, 0.0], [0.0, 1.0]]),
    "by 1 rad": torch.tensor([[math.cos(1), -math.sin(1)], [math.sin(1), math.cos(1)]]),
}


@pytest.mark.parametrize("task", ["navigation", "predator-prey"])
@pytest.mark.parametrize("element", TURNS)
def test_a_force_turns_with_what_is_seen_and_a_value_does_not(task, element):
    env = make(task, 6, [0, 1], {"actions": "continuous"})
    spec, matrix = env.spec, TURNS[element]
    env.reset()
    seen = env.step(env.random_action()).next
    for config, holds in ((SetEquivariantConfig(), True), (SetConfig(), False)):
        io = IoSpec(spec, "own")
        actor = joint(spec, lambda g, _, config=config, io=io: build_network(g, 0, 2, config, 1.0, io), "own")
        rows = seen.obs.flatten(1, 2)
        force, other = actor(rows), actor(turned(spec.observation, rows, matrix, "own"))
        assert force.abs().amax() > 1e-2
        assert bool((force @ matrix.T - other).abs().amax() < 1e-4) is holds
        critic = network(spec, "state", config)
        gap = critic(seen.state) - critic(turned(spec.state, seen.state, matrix, "state"))
        assert bool(gap.abs().amax() < 1e-4) is holds


@pytest.mark.parametrize("element", ["rot90", "flip"])
def test_preferences_among_moves_change_places_when_the_scene_turns(element):
    spec, seen = scene()
    actor, rows, matrix = network(spec, config=SetEquivariantConfig()), seen.obs.flatten(1, 2), TURNS[element]
    points = torch.tensor(spec.action.points)
    goes_to = [int((points - points[a] @ matrix.T).norm(dim=-1).argmin()) for a in range(5)]
    logits, other = actor(rows), actor(turned(spec.observation, rows, matrix, "own"))
    torch.testing.assert_close(other[..., goes_to], logits, **CLOSE)
    assert (other - logits).abs().amax() > 1e-2, "negative control: the scene did turn"


def test_what_has_no_direction_is_refused_by_the_equivariant_network():
    wheels = make("formation", 1, [0], {"actions": "discrete"}).spec
    with pytest.raises(UserError, match="acts along directions of the plane; use set"):
        network(wheels, config=SetEquivariantConfig())


def test_memory_behind_sets_unrolls_as_it_steps_and_knows_no_order():
    spec, _ = scene()
    built = build_network(
        generators((0, 1), "x"),
        spec.observation.width + 2,
        5,
        SetConfig(memory=True, hidden=(8,), width=4),
        1.0,
        IoSpec(spec, "own"),
    )
    x = torch.randn(2, 3, 4, spec.observation.width + 2, generator=torch.Generator().manual_seed(0))
    memory, steps = built.initial_memory(2, 3, x), []
    for t in range(4):
        y, memory = built.step(x[:, :, t], memory)
        steps.append(y)
    whole = built.unroll(x)
    torch.testing.assert_close(whole, torch.stack(steps, 2), **CLOSE)
    exchanged, landmarks = x.clone(), spec.observation.slices()["landmarks"]
    exchanged[:, :, 0, landmarks] = x[:, :, 0, landmarks].unflatten(-1, (-1, 2)).flip(-2).flatten(-2)
    torch.testing.assert_close(built.unroll(exchanged), whole, **CLOSE)
    for column in (landmarks.start, -1):  # a landmark of the first step and the last number behind are remembered
        other = x.clone()
        other[:, :, 0, column] += 1
        assert not torch.allclose(built.unroll(other)[:, :, -1], whole[:, :, -1], **CLOSE)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"action": Discrete(Kind.VECTOR, ((0.0, 0.0), (1.0, 0.0), (0.0, 0.0)), ("stay", "go", "load"))},
            "tells actions apart by their directions, and 'stay' and 'load' have the same",
        ),
        ({"symmetry": "c1", "nearly": ""}, "is no symmetry of its dynamics and reward"),
        (
            {"action": FORCE, "observation": layout(Field("heights", Kind.SCALAR, 3, family="hill"))},
            "makes forces of vectors, and none is seen",
        ),
    ],
)
def test_what_the_equivariant_network_over_sets_cannot_tell_or_make_is_refused(changes, sentence):
    spec = replace(scene()[0], **changes)
    io = IoSpec(spec, "own")
    with pytest.raises(UserError, match=sentence):
        build_network(generators((0,), "x"), io.layout.width, 5, SetEquivariantConfig(), 1.0, io)


def test_the_equivariant_network_over_sets_remembers_nothing():
    with pytest.raises(UserError, match="set-equivariant remembers nothing; use set"):
        network(scene()[0], config=SetEquivariantConfig(memory=True))
