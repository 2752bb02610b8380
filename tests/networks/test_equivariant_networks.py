"""Networks that commute with a group: in every layer, with any weights, after training; and plain ones do not."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from esp_cli.networks.build import NETWORKS, NetworkConfig, build_network
from esp_cli.networks.constrained import ConstrainedLinear, Gated
from esp_cli.networks.contract import IoSpec, Memoryless
from esp_cli.networks.layers import SeedMLP, orthogonal
from esp_cli.networks.message_passing import MessagePassing, PictureEncoder, distinct
from esp_cli.networks.symmetrised import LocalFrame, Symmetrised
from esp_cli.symmetry import PlaneElement, cyclic, dihedral, parse_group, transform_set
from esp_cli.symmetry.maps import Block, layout_blocks, regular, trivial
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from esp_envs import UserError, make
from esp_envs.spec import Field, Kind, Spaces, TaskSpec, discrete_moves, layout
from tests.networks.gradients import assert_same_gradients
from tests.symmetry.checks import policy_equivariance_error

SEEDS, WORLDS = 2, 12
EXACT = 1e-5
"""Of float32, relative to outputs of the size of 1."""


def generators(*seeds: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def scene(task: str = "wildlife", **settings) -> tuple[TaskSpec, Tensor, Tensor]:
    env = make(task, WORLDS, range(SEEDS), settings)
    observation = env.reset()
    return env.spec, observation.obs, observation.state


def stir(network: nn.Module) -> None:
    """Give a network random weights and biases, so that nothing holds by the way it begins."""
    g = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=g) * 0.3)


def turned(block: Block, g: int, x: Tensor) -> Tensor:
    """Apply an element to features [..., copies * d]."""
    matrix = torch.as_tensor(block.matrices[g], dtype=x.dtype)
    return (x.unflatten(-1, (block.copies, -1)) @ matrix.T).flatten(-2)


def message_passing(spec: TaskSpec, name: str, group: str = "c4") -> MessagePassing:
    config = NETWORKS[name](hidden=(16, 16), **({"group": group} if name == "empn" else {}))
    network = build_network(generators(0, 1), spec.observation.width, 5, config, 1.0, IoSpec(spec, "own"))
    assert isinstance(network, MessagePassing)
    stir(network)
    return network


@pytest.mark.parametrize("group", ["c4", "d4", "c2"])
def test_every_layer_of_the_equivariant_message_passing_network_turns_with_the_world(group) -> None:
    spec, obs, _ = scene()
    network = message_passing(spec, "empn", group)
    elements = parse_group(group, 3).elements
    rows = obs.flatten(1, 2)
    pictures = rows[..., network.picture]
    here = network.features(rows)
    responses = network.encoder.responses(network.encoder.as_pictures(pictures))
    blocks = [network.encoder.output, *(layer.outputs[0] for layer in network.layers)]
    convolved = [layer.outputs[0] for layer in network.encoder.layers]
    for transform in transform_set(group, spec).each():
        (element,) = transform.elements
        g = elements.index(element)
        there = network.features(transform.obs(obs).flatten(1, 2))
        for block, before, after in zip(blocks, here, there, strict=True):
            torch.testing.assert_close(after, turned(block, g, before), atol=EXACT, rtol=EXACT)
        moved = network.encoder.as_pictures(transform.obs(obs).flatten(1, 2)[..., network.picture])
        for block, before, after in zip(convolved, responses, network.encoder.responses(moved), strict=True):
            # a response's place turns as a pixel does, its channels as regular features
            channels = turned(block, g, before)
            picture = channels.flip(2) if PlaneElement.of(element).mirrored else channels
            expected = picture.rot90(int(PlaneElement.of(element).turn * 4), (2, 3))
            torch.testing.assert_close(after, expected, atol=EXACT, rtol=EXACT)


@torch.no_grad()
def errors(spec: TaskSpec, config: NetworkConfig, obs: Tensor, state: Tensor, group: str, reads="own") -> float:
    """The largest equivariance error of a policy and a critic with random weights, over a group."""
    width = IoSpec(spec, reads).layout.width
    outputs = IoSpec(spec, "own").outputs(cyclic(1))[0].width if hasattr(spec.action, "count") else spec.action.width
    actor = build_network(generators(0, 1), spec.observation.width, outputs, config, 1.0, IoSpec(spec, "own"))
    critic = build_network(generators(0, 1), width, 1, config, 1.0, IoSpec(spec, reads, 1))
    stir(actor), stir(critic)

    def policy(x: Tensor) -> Tensor:
        return actor.unroll(x.unsqueeze(2).transpose(2, 3).flatten(1, 2)).unflatten(1, x.shape[1:3]).squeeze(-2)

    def value(x: Tensor) -> Tensor:
        rows = {"own": x.flatten(1, 2) if x.dim() == 4 else x, "observations": x.flatten(2), "state": x}[reads]
        return critic.unroll(rows.unsqueeze(2)).flatten(1, 2)

    worst = 0.0
    for transform in transform_set(group, spec).each():
        moved = transform.state(state) if reads == "state" else transform.obs(obs)
        here = value(state if reads == "state" else obs)
        worst = max(
            worst,
            policy_equivariance_error(policy, obs, transform),
            float((value(moved) - here).abs().max() / here.abs().max().clamp_min(1.0)),
        )
    return worst


@pytest.mark.parametrize("group", ["c4", "d4"])
def test_the_equivariant_message_passing_network_is_exact_and_the_standard_one_is_not(group) -> None:
    spec, obs, state = scene(num_agents=4, convention="corrected")
    equivariant = NETWORKS["empn"](hidden=(16, 16), group=group)
    assert errors(spec, equivariant, obs, state, group) < EXACT
    standard = NETWORKS["mpn"](hidden=(16, 16))
    assert errors(spec, standard, obs, state, group) > 1e-2
    ensemble = standard.model_copy(update={"symmetrise": group})
    assert errors(spec, ensemble, obs, state, group) < EXACT


def test_c4_is_not_enough_for_mirrors() -> None:
    spec, obs, state = scene()
    assert errors(spec, NETWORKS["empn"](hidden=(16,), group="c4"), obs, state, "d4") > 1e-2


@pytest.mark.parametrize("reads", ["own", "observations", "state"])
@pytest.mark.parametrize(
    ("task", "settings", "group"),
    [
        ("navigation", {}, "d4"),
        ("navigation", {"actions": "continuous"}, "c8"),
        ("predator-prey", {"num_predators": 2}, "c4"),
        ("formation", {"num_agents": 3}, "d4"),
    ],
    ids=str,
)
def test_the_equivariant_network_for_vectors_is_exact_and_a_perceptron_is_not(task, settings, group, reads) -> None:
    spec, obs, state = scene(task, **settings)
    exact = NETWORKS["equivariant"](hidden=(16, 16), group=group)
    assert errors(spec, exact, obs, state, group, reads) < EXACT
    plain = NETWORKS["mlp"](hidden=(16, 16))
    assert errors(spec, plain, obs, state, group, reads) > 1e-2
    assert errors(spec, plain.model_copy(update={"symmetrise": group}), obs, state, group, reads) < EXACT
    local = plain.model_copy(update={"symmetrise": f"local-{group}"})
    assert errors(spec, local, obs, state, group, reads) < EXACT


@pytest.mark.parametrize("group", ["flip-x", "flip-y", "flip-diagonal", "c3", "rot120,flip-x", "rot120,flip-y", "d2"])
def test_a_local_frame_is_exact_wherever_the_mirrors_of_its_group_lie(group) -> None:
    spec, obs, state = scene("navigation", actions="continuous")
    local = NETWORKS["mlp"](hidden=(16, 16), symmetrise=f"local-{group}")
    assert errors(spec, local, obs, state, group) < EXACT


class Echo(Memoryless):
    def forward(self, x: Tensor) -> Tensor:
        return x


def test_a_local_frame_by_hand() -> None:
    """Of the turns of (0, 3) + (-1, 0), that by -90 degrees, (3, 1), lies nearest to the direction of 45 degrees."""
    seen = layout(Field("velocity", Kind.VECTOR), Field("goal", Kind.VECTOR), Field("age", Kind.SCALAR))
    spaces = Spaces(num_agents=1, observation=seen, state=seen, action=discrete_moves(4), symmetry="c4")
    network = LocalFrame(Echo(), IoSpec(spaces, "own", num_values=5), "c4")
    row = torch.tensor([[[0.0, 3.0, -1.0, 0.0, 7.0]]])
    torch.testing.assert_close(network.step(row, row[..., :0])[0], torch.tensor([[[3.0, 0.0, 0.0, 1.0, 7.0]]]))
    torch.testing.assert_close(network.unroll(row.unsqueeze(2))[:, :, 0], torch.tensor([[[3.0, 0.0, 0.0, 1.0, 7.0]]]))
    blind = replace(spaces, observation=layout(Field("age", Kind.SCALAR)))
    with pytest.raises(ValueError, match=r"network\.symmetrise=local-c4 needs vectors, and the task shows none"):
        LocalFrame(Echo(), IoSpec(blind, "own", num_values=1), "c4")


def test_a_local_frame_is_one_where_the_vectors_cancel() -> None:
    """(3, 1) - (3, 1) / 1.37 points as (3, 1) does, and its turns with it."""
    seen = layout(Field("ways", Kind.VECTOR, 2))
    spaces = Spaces(num_agents=1, observation=seen, state=seen, action=discrete_moves(4), symmetry="c4")
    network = LocalFrame(Echo(), IoSpec(spaces, "own", num_values=4), "c4")
    rows = torch.tensor([[[3.0, 1.0, -3.0, -1.0], [-1.0, 3.0, 1.0, -3.0], [-3.0, -1.0, 3.0, 1.0]]])
    assert network(rows).tolist() == [[[3.0, 1.0, -3.0, -1.0]] * 3]
    orders = replace(spaces, symmetry="c4*ways-2")
    with pytest.raises(UserError, match="moves items, which no frame tells apart; use c4"):
        LocalFrame(Echo(), IoSpec(orders, "own", num_values=4), "c4*ways-2")


def test_a_field_without_items_is_no_block() -> None:
    seen = layout(Field("others", Kind.VECTOR, 0), Field("goal", Kind.VECTOR))
    spaces = Spaces(num_agents=1, observation=seen, state=seen, action=discrete_moves(4), symmetry="c4")
    io = IoSpec(spaces, "own", num_values=1)
    network = build_network(generators(0, 1), 2, 1, NETWORKS["equivariant"](hidden=(4,), group="c4"), 1.0, io)
    rows = torch.tensor([[3.0, 1.0], [-1.0, 3.0]]).expand(2, -1, -1)
    here, there = network(rows).unbind(1)
    torch.testing.assert_close(here, there)


def test_a_recurrent_ensemble_keeps_the_memories_of_its_images_apart() -> None:
    spec, obs, _ = scene("navigation")
    config = NETWORKS["gru"](hidden=(8,), symmetrise="c4")
    network = build_network(generators(0, 1), spec.observation.width, 5, config, 1.0, IoSpec(spec, "own"))
    assert isinstance(network, Symmetrised)
    assert network.memory_width == 4 * 8
    rows = torch.stack([obs.flatten(1, 2), 0.5 * obs.flatten(1, 2), -obs.flatten(1, 2)], 2)
    memory, steps = network.initial_memory(SEEDS, rows.shape[1], rows), []
    for t in range(3):
        y, memory = network.step(rows[:, :, t], memory)
        steps.append(y)
    torch.testing.assert_close(network.unroll(rows), torch.stack(steps, 2))
    (transform,) = transform_set("rot90", spec).each()
    moved = transform.obs(rows.unflatten(1, (WORLDS, 3)).transpose(2, 3)).transpose(2, 3).flatten(1, 2)
    back = transform.pull_back(network.unroll(moved))
    torch.testing.assert_close(back, network.unroll(rows), atol=EXACT, rtol=EXACT)


def test_the_group_of_one_element_gives_plain_layers() -> None:
    one = cyclic(1)
    layer = ConstrainedLinear(generators(3), [trivial(one, 4), regular(one, 3)], [regular(one, 5)], 1.5)
    torch.testing.assert_close(layer.weight(), orthogonal(generators(3), 7, 5, 1.5))
    spec, obs, _ = scene("navigation")
    config = NETWORKS["equivariant"](hidden=(8, 8), group="c1")
    ours = build_network(generators(0, 1), 14, 5, config, 0.1, IoSpec(spec, "own"))
    theirs = SeedMLP(generators(0, 1), (14, 8, 8, 5), "tanh", 0.1)
    torch.testing.assert_close(ours.unroll(obs), theirs(obs.flatten(1, 2)).unflatten(1, obs.shape[1:3]))


@pytest.mark.parametrize("group", [cyclic(4), dihedral(4), cyclic(8)], ids=lambda g: g.name)
def test_initial_weights_have_the_size_of_plain_ones(group) -> None:
    (vectors,) = layout_blocks(make("navigation", 1, [0]).spec.state, group)[:1]
    for source in (vectors, regular(group, 12)):
        layer = ConstrainedLinear(generators(*range(4)), [source], [regular(group, 12)], 1.0)
        plain = orthogonal(generators(*range(4)), source.width, 12 * group.order, 1.0)
        assert layer.weight().square().mean().item() == pytest.approx(plain.square().mean().item(), rel=0.25)


def test_pictures_that_occur_several_times_are_encoded_once_and_nobody_notices() -> None:
    spec, _, _ = scene()
    g = torch.Generator().manual_seed(0)
    sorts = torch.rand(SEEDS, 20, 441, generator=g).round()
    pick = torch.randint(20, (SEEDS, 100), generator=g)
    pictures = torch.stack([sorts[s][pick[s]] for s in range(SEEDS)])
    encoder = PictureEncoder(generators(0, 1), spec.observation.fields[0], cyclic(1))
    stir(encoder)
    which, place = distinct(pictures, encoder.keys)
    assert which.shape == (SEEDS, 32)
    for s in range(SEEDS):
        assert torch.equal(pictures[s][which[s][place[s]]], pictures[s])
        assert len(place[s].unique()) == len(pick[s].unique())
    ours, theirs = encoder(pictures), encoder.encode(pictures)
    torch.testing.assert_close(ours, theirs)
    weight = torch.randn(ours.shape, generator=g)
    assert_same_gradients(ours, theirs, weight, list(encoder.parameters()), atol=1e-4)


def test_convolutions_and_their_gradients_are_those_of_torch() -> None:
    spec, obs, _ = scene()
    encoder = PictureEncoder(generators(0, 1), spec.observation.fields[0], cyclic(4))
    stir(encoder)
    rows = obs[..., :441].flatten(1, 2)
    x = rows.unflatten(-1, (1, 21, 21))
    features = []
    for s in range(SEEDS):
        y = x[s]
        for layer, side, stride in zip(encoder.layers, encoder.sides, encoder.strides, strict=True):
            weight = layer.weight()[s].T.unflatten(1, (-1, side, side))
            y = torch.relu(torch.nn.functional.conv2d(y, weight, layer.bias()[s, 0], stride))
        features.append(y.amax((2, 3)))
    theirs, ours = torch.stack(features), encoder.encode(rows)
    torch.testing.assert_close(ours, theirs)
    weight = torch.randn(ours.shape)
    assert_same_gradients(ours, theirs, weight, list(encoder.parameters()), atol=1e-3)


def test_a_stride_that_would_leave_out_the_last_pixels_is_not_taken() -> None:
    """Pictures of 8 x 8 have no middle: by steps of two, a turned picture would lose other pixels."""
    encoder = PictureEncoder(generators(0, 1), Field("view", Kind.PICTURE, pixels=(8, 8)), cyclic(4))
    stir(encoder)
    view = torch.rand(SEEDS, 5, 8, 8, generator=torch.Generator().manual_seed(0))
    features = [encoder.encode(x.flatten(2)) for x in (view, view.rot90(1, (2, 3)))]
    here, there = (x.unflatten(-1, (-1, 4)).sum(-1) for x in features)  # over the four turns of each feature
    torch.testing.assert_close(there, here, atol=EXACT, rtol=EXACT)
    assert not torch.allclose(*features, atol=0.1), "each by itself goes to another place"


@pytest.mark.parametrize("name", ["mpn", "empn"])
def test_a_seed_alone_equals_itself_among_others(name) -> None:
    spec, obs, _ = scene()
    config = NETWORKS[name](hidden=(16,))
    both, alone = (
        build_network(generators(*seeds), spec.observation.width, 5, config, 1.0, IoSpec(spec, "own"))
        for seeds in ((0, 1), (1,))
    )
    rows = obs.flatten(1, 2)
    ours, theirs = both.unroll(rows.unsqueeze(2)), alone.unroll(rows[1:].unsqueeze(2))
    assert torch.equal(ours[1:], theirs)
    (gradient,) = torch.autograd.grad(ours[0].sum(), [next(both.parameters())])
    assert gradient[1].abs().max() == 0


def test_drones_out_of_reach_are_not_heard() -> None:
    spec, obs, _ = scene(num_agents=2, width=13, height=13)
    network = message_passing(spec, "mpn")
    obs[:, :, :, -2:] = torch.tensor([3.0, 3.0])  # just out of reach
    alone = network(obs.flatten(1, 2))
    other = obs.clone()
    other[:, :, 1, :-2] = obs[:, :, 0, :-2].flip(1)
    assert torch.equal(network(other.flatten(1, 2))[:, ::2], alone[:, ::2])
    for rows in (obs, other):
        rows[:, :, :, -2:] = torch.tensor([3.0, 2.0])
    assert not torch.equal(network(other.flatten(1, 2))[:, ::2], network(obs.flatten(1, 2))[:, ::2])


@pytest.mark.parametrize(
    ("task", "overrides", "message"),
    [
        ("navigation", {"network.name": "mpn", "mappo.critic_input": "own"}, "navigation does not show them"),
        ("wildlife", {"mappo.critic_input": "observations"}, "set mappo.critic_input=own"),
        ("wildlife", {"network.name": "equivariant"}, "use empn or mlp"),
        ("wildlife", {"network.name": "gru", "mappo.num_steps": 100}, "may end early"),
        ("navigation", {"network.name": "equivariant", "network.group": "so2"}, "finite group that moves no agents"),
        ("navigation", {"network.name": "equivariant", "network.group": "c8"}, "no action"),
        ("navigation", {"network.symmetrise": "agents"}, "choose a finite group that moves no agents"),
        ("navigation", {"network.name": "gru", "network.symmetrise": "local-d4"}, "for networks without memory"),
        ("navigation", {"network.name": "equivariant", "network.layer_norm": True}, "the network equivariant has name"),
    ],
)
def test_what_does_not_fit_is_refused(task, overrides, message) -> None:
    with pytest.raises(ValueError, match=message):
        build_learner(resolve_config(task, overrides={"mappo.num_envs": 2} | overrides))


def relaxed(spec: TaskSpec, relax: float, relaxation: str = "residual") -> nn.Module:
    config = NETWORKS["equivariant"](hidden=(16, 16), group="d4", relax=relax, relaxation=relaxation)
    return build_network(generators(0, 1), spec.observation.width, 5, config, 1.0, IoSpec(spec, "own"))


@torch.no_grad()
def symmetry_gap(network: nn.Module, spec: TaskSpec, obs: Tensor) -> float:
    """Return the largest difference between outputs and those of turned inputs, turned back."""
    rows, gap = obs.flatten(1, 2), 0.0
    for g in transform_set("d4", spec).each():
        there = network(g.obs(obs).flatten(1, 2)).unflatten(1, obs.shape[1:3])
        gap = max(gap, float((g.pull_back(there) - network(rows).unflatten(1, obs.shape[1:3])).abs().max()))
    return gap


@pytest.mark.parametrize("relaxation", ["residual", "weights"])
def test_a_relaxed_network_begins_equivariant_and_can_give_it_up(relaxation: str) -> None:
    spec, obs, _ = scene("navigation")
    network = relaxed(spec, 0.5, relaxation)
    assert symmetry_gap(network, spec, obs) < EXACT
    network(obs.flatten(1, 2)).square().sum().backward()
    for layer in network.layers:
        own = [layer.free] if relaxation == "residual" else [v for v in layer.shares if v.shape[-1] > 1]
        assert all(parameter.grad.abs().max() > 0 for parameter in own)
    stir(network)
    assert symmetry_gap(network, spec, obs) > 0.1
    strict = relaxed(spec, 0.0, relaxation)
    stir(strict)
    assert symmetry_gap(strict, spec, obs) < 10 * EXACT
    assert len(list(strict.parameters())) < len(list(network.parameters()))


def test_a_gate_begins_nearly_closed_and_learns_where_to_open() -> None:
    """With a = sigmoid(relax g - 3), where g begins at 0: 1 / (1 + e^3) = 0.0474."""
    spec, obs, _ = scene("navigation")
    network, rows = relaxed(spec, 0.5, "gate"), obs.flatten(1, 2)
    assert isinstance(network, Gated)
    exact, free = network.exact(rows), network.free(rows)
    torch.testing.assert_close(network(rows), exact + 0.0474259 * (free - exact))
    assert symmetry_gap(network.exact, spec, obs) < EXACT < symmetry_gap(network, spec, obs)
    network(rows).square().sum().backward()
    assert sum(parameter.grad.abs().max() > 0 for parameter in network.gate.parameters()) == 2, "of its last layer"
    stir(network)
    exact, free, share = network.exact(rows), network.free(rows), torch.sigmoid(0.5 * network.gate(rows) - 3)
    torch.testing.assert_close(network(rows), (1 - share) * exact + share * free)
    assert share.std() > 1e-3, "it differs between places"


@pytest.mark.parametrize(("relax", "relaxation"), [(0.0, "weights"), (0.5, "residual"), (0.5, "weights")])
@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("settings", [{}, {"actions": "continuous"}], ids=["directions", "forces"])
def test_the_vjp_is_that_of_autograd_through_the_layers(relax, relaxation, activation, settings) -> None:
    """Also where outputs are forces: vectors, whose bias is 0 and no parameter."""
    spec, obs, _ = scene("navigation", **settings)
    config = NETWORKS["equivariant"](
        hidden=(16, 16), group="d4", relax=relax, relaxation=relaxation, activation=activation
    )
    width = 2 if settings else 5
    network = build_network(generators(0, 1), spec.observation.width, width, config, 1.0, IoSpec(spec, "own"))
    stir(network)
    x = torch.randn_like(obs).flatten(1, 2).unsqueeze(2)
    given = network.with_vjp(x, (*x.shape[:-1], width))
    first, second, last = network.layers
    act = getattr(torch, activation)
    expected = last(act(second(act(first(x.flatten(1, 2)))))).unsqueeze(2)
    torch.testing.assert_close(given.tensor, expected.detach())
    torch.testing.assert_close(network.unroll(x), expected)
    gradient, parameters = torch.randn_like(given.tensor), [*network.parameters()]
    found = given.vjp(gradient)
    for ours, theirs in zip(found, torch.autograd.grad(expected, parameters, gradient), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
    assert all(ours.abs().max() > 0 for ours in found), "negative control: no gradient is empty"


@pytest.mark.parametrize(
    ("relax", "relaxation", "features", "between"),
    [(0.0, "weights", 23, 4232), (0.1, "weights", 16, 4096), (0.1, "residual", 23, 38088)],
)
def test_filter_banks_have_about_as_many_weights_as_a_plain_layer(relax, relaxation, features, between):
    """A plain layer has 64^2 = 4096; 23^2 8, two banks of 16^2 8. A free layer beside 23 features has (23 8)^2 more."""
    spec, _, _ = scene("navigation")
    config = NETWORKS["equivariant"](hidden=(64, 64), group="d4", relax=relax, relaxation=relaxation)
    middle = build_network(generators(0), spec.observation.width, 5, config, 1.0, IoSpec(spec, "own")).layers[1]
    assert middle.outputs[0].copies == features
    kept = [parameter for name, parameter in middle.named_parameters() if "bias" not in name and "shares" not in name]
    assert sum(parameter.numel() for parameter in kept) == between


def test_a_relaxed_layer_by_hand() -> None:
    """W is that of the constrained layer plus half of F: with F = 2, one more in each entry."""
    group = cyclic(2)
    blocks = [regular(group, 1)], [regular(group, 1)]
    strict, soft = (ConstrainedLinear(generators(0), *blocks, 1.0, relax) for relax in (0.0, 0.5))
    with torch.no_grad():
        soft.free.fill_(2.0)
        soft.free_bias[0, 0] = torch.tensor([4.0, -4.0])
    torch.testing.assert_close(soft.weight(), strict.weight() + 1)
    assert (soft.bias() - strict.bias()).flatten().tolist() == [2.0, -2.0]
    x = torch.randn(1, 3, 2)
    torch.testing.assert_close(soft(x), x @ soft.weight() + soft.bias())


def test_relaxed_weights_by_hand() -> None:
    """The first output of each feature has 1.5 times the first bank, the second that and as much of the second bank."""
    group = cyclic(2)
    blocks = [regular(group, 1)], [regular(group, 2)]
    soft = ConstrainedLinear(generators(0), *blocks, 1.0, 0.5, "weights")
    first = soft.weight().detach()
    assert torch.equal(first, ConstrainedLinear(generators(0), *blocks, 1.0).weight())
    with torch.no_grad():
        soft.shares[0][0, :, 0] = torch.tensor([[1.0, 0.0], [0.0, 2.0]])
    second = soft.bank.weight()
    torch.testing.assert_close(soft.weight()[..., 0::2], 1.5 * first[..., 0::2])
    torch.testing.assert_close(soft.weight()[..., 1::2], first[..., 1::2] + second[..., 1::2])


@torch.no_grad()
def test_weights_that_are_the_same_for_all_outputs_of_a_feature_keep_the_symmetry() -> None:
    spec, obs, _ = scene("navigation")
    network = relaxed(spec, 0.5, "weights")
    for layer in network.layers[:-1]:
        for share in layer.shares:
            share.fill_(0.7)
    assert symmetry_gap(network, spec, obs) < 10 * EXACT
    network.layers[0].shares[0][..., 0] += 1.0
    assert symmetry_gap(network, spec, obs) > 1e-3
