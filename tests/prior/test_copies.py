"""A batch with its copies: which rows are learned from, what copies inherit, and Eq. 10 by hand."""

from dataclasses import replace

import pytest
import torch

from esp_cli.prior import SeedBatch, SymmetryPrior
from esp_cli.prior.config import PriorConfig
from esp_cli.symmetry import build_transform, mirror, rotation
from esp_envs import Field, Items, Kind, Spaces, layout
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Discrete

MOVES = Discrete(Kind.VECTOR, (RIGHT, UP, LEFT, DOWN), ("right", "up", "left", "down"))
SPACES = Spaces(
    num_agents=2,
    observation=layout(Field("velocity", Kind.VECTOR), Field("other", Kind.VECTOR, items=Items.OTHERS)),
    state=layout(Field("positions", Kind.VECTOR, 2, items=Items.AGENTS)),
    action=MOVES,
    symmetry="d4*agents",
)
"""A task that nobody wrote: the prior asks for no more."""


class Masked(SeedBatch):
    """Rows of which the last of every seed does not count."""

    @property
    def played(self):
        mask = torch.ones(self.obs.shape[:3], dtype=torch.bool)
        mask[:, -1] = False
        return mask


class Squared:
    def divergence(self, p, q):
        return (p - q).square().sum(-1)


def rows(num_seeds=2, count=3, kind=SeedBatch):
    """Return rows [S, B, 1, ...] of random numbers."""
    g = torch.Generator().manual_seed(0)
    lead = (num_seeds, count, 1)
    return kind(
        torch.randn(*lead, 2, 4, generator=g),
        torch.randn(*lead, 4, generator=g),
        torch.randint(4, (*lead, 2), generator=g),
    )


def prior(replays=False, **choice):
    return SymmetryPrior(
        PriorConfig(**{"transforms": "rot90", "consistency_coef": 0.5, **choice}), SPACES, "cpu", replays
    )


def test_originals_come_first_and_copies_follow_transformed():
    batch = rows()
    made = prior(copies="all", transforms="rot90,flip-x").copies(batch, [])
    assert made.rows.count == 9
    for name in ("obs", "state", "action"):
        here, turned, mirrored = getattr(made.rows, name).split(3, 1)
        assert torch.equal(here, getattr(batch, name))
        for g, there in ((rotation(90), turned), (mirror(0), mirrored)):
            expected = getattr(build_transform([g], SPACES), name)(here)
            torch.testing.assert_close(there, expected, rtol=0, atol=0)


def test_what_is_learned_from_depends_on_the_kind():
    batch, values = rows(), torch.arange(12.0).view(2, 6, 1, 1)
    learned = {kind: prior(kind=kind).copies(batch, []) for kind in ("esp", "augment", "consistency")}
    assert [learned[kind].loss_rows.count for kind in learned] == [6, 6, 3]
    assert [learned[kind].for_loss(values).shape[1] for kind in learned] == [6, 6, 3]
    assert learned["esp"].original(values).flatten().tolist() == [0, 1, 2, 6, 7, 8]
    none = prior(kind="none").copies(batch, [])
    assert none.rows is batch
    assert none.penalty(value=values[:, :3]).value.item() == 0


@pytest.mark.parametrize(
    ("replays", "replay", "in_batch", "beside"),
    [(True, "stored", 0, 1), (True, "sampled", 1, 0), (False, "stored", 1, 0)],
)
def test_copies_are_made_of_batches_or_stored_in_a_replay(replays, replay, in_batch, beside):
    made = prior(replays, kind="augment", replay=replay)
    batch = rows()
    assert made.copies(batch, []).rows.count == 3 * (1 + in_batch)
    assert [made.num_stored, len(made.stored(batch, []))] == [beside, beside]


def test_values_of_copies_come_back_to_the_originals_agents():
    made = prior(transforms="agents-1-0").copies(rows(1, 1), [])
    assert made.frame.pull_values(torch.tensor([1.0, 2, 2, 1]).view(1, 2, 1, 2)).flatten().tolist() == [1, 2, 1, 2]
    assert made.frame.pull_values(torch.tensor([3.0, 4]).view(1, 2, 1, 1)).flatten().tolist() == [3, 4]
    assert made.tiled(torch.tensor([[[[1.0, 2.0]]]])).flatten().tolist() == [1, 2, 1, 2]


def test_a_learner_adapts_copies_and_no_original():
    batch = rows()
    made = prior().copies(batch, [], lambda copied: replace(copied, state=copied.state + 1))
    here, there = made.rows.state.split(3, 1)
    assert torch.equal(here, batch.state)
    torch.testing.assert_close(there, build_transform([rotation(90)], SPACES).state(batch.state) + 1)


def test_the_penalty_by_hand():
    """S_pi: logits (1, 0, 0, 0) everywhere, pulled back by rot90 (0, 0, 0, 1): distance 2. S_V: (3 - 1)^2 = 4."""
    logits = torch.tensor([1.0, 0, 0, 0]).expand(2, 6, 1, 2, 4)
    values = torch.tensor([3.0, 3, 3, 1, 1, 1]).view(1, 6, 1, 1).expand(2, 6, 1, 1)

    def penalty(**choice):
        return prior(**choice).copies(rows(), []).penalty(policy=(Squared(), logits), value=values).value.tolist()

    assert penalty() == [0.5 * (2 + 4)] * 2
    assert penalty(kind="augment") == 0
    assert penalty(consistency_coef=0) == 0


def test_rows_that_do_not_count_enter_no_gap():
    values = torch.tensor([0.0, 0, 0, 1, 1, 7]).view(1, 6, 1, 1)
    assert prior().copies(rows(1), []).gaps(value=values)["value"].tolist() == [(1 + 1 + 49) / 3]
    assert prior().copies(rows(1, kind=Masked), []).gaps(value=values)["value"].tolist() == [1]


def test_chunks_take_their_copies_along():
    made = prior().copies(rows(), [])
    chunks = made.chunks(2)
    assert [chunk.rows.count for chunk in chunks] == [4, 2]
    assert torch.equal(chunks[1].rows.obs[:, 1:], made.rows.obs[:, 5:])


def test_errors_are_measured_with_a_prior_and_without():
    def answers(batch):
        return {"value": batch.state[..., :1]}

    def symmetric(batch):
        return {"value": batch.state.square().sum(-1, keepdim=True)}

    for kind in ("esp", "none"):
        assert prior(kind=kind).errors(rows(), answers)["value_symmetry_error"].min() > 0.1
        assert prior(kind=kind).errors(rows(), symmetric)["value_symmetry_error"].max() < 1e-6
    for symmetry in ("flip-x", "d2", "c4"):
        probing = SymmetryPrior(PriorConfig(kind="none"), replace(SPACES, symmetry=symmetry))
        assert "value_symmetry_error" in probing.errors(rows(), answers), f"{symmetry} holds a mirror or a turn"


def test_a_seed_draws_the_same_elements_alone_and_among_others():
    made = prior(transforms="d4")

    def drawn(*seeds):
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        return [made.copies(rows(len(seeds)), generators).transforms[0].elements for _ in range(20)]

    together, alone = drawn(3, 4), drawn(4)
    assert [pair[1] for pair in together] == [single[0] for single in alone]
    assert [pair[0] for pair in together] != [pair[1] for pair in together]
