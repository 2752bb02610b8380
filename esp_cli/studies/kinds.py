"""The kinds of studies as data: what each of them runs, varies and holds fixed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from esp_cli.defaults import Mode
from esp_cli.studies import paper

Settings = Mapping[str, object]  # dotted names of settings -> values
TRIALS = "-trials"  # how the kind of a study ends that holds the trials of a search
GROUP = "<group>"  # stands for the group that the user chooses
ALGORITHMS = ("maddpg", "qmix", "mappo")  # in the order of the paper's table
PAPER_PRIOR: Settings = {"prior.transforms": "rot90", "prior.consistency_coef": 0.5}
"""What the ablations vary one thing of: a quarter turn and c = 0.5, as in the paper."""
PLAIN_AND_ESP: Mapping[str, Settings] = {"plain": {"prior.kind": "none"}, "ESP": {"prior.kind": "esp"}}
Breakings = Mapping[str, Mapping[str, tuple[float, ...]]]
BREAKINGS: Breakings = {
    "navigation": {"action_turn_rad": (0.5, 1.57), "reward_offset": (0.1, 0.3), "mud": (0.5, 0.9), "wind": (0.3, 0.6)},
    "predator-prey": {"action_turn_rad": (0.5, 1.57), "mud": (0.5, 0.9), "wind": (0.3, 0.6)},
    "formation": {"slope": (0.3, 0.6)},
    "wildlife": {"wind": (0.4, 0.8)},
}
"""By task the settings that break its symmetry, those that say most about a prior first, and their strengths.

Beside them is the unbroken task, which all settings of a task share.
"""
UNBROKEN = "unbroken"
COEFFICIENTS = (0.0, 0.01, 0.05, 0.1, 0.5, 1.0)


@dataclass(frozen=True)
class Team:
    """One row of a table of teams."""

    label: str  # name of the row
    settings: Settings  # of the task
    place: tuple[str, ...]  # of the row in the paper's numbers


@dataclass(frozen=True)
class StudyKind:
    """A kind of study: all that tells it from the others."""

    title: str  # one line for people
    # what the rows of its table are. With "panels" each algorithm stands beside itself with the prior, as in the
    # paper's tables; with "variants" each panel is one algorithm, whose variants are compared with the first
    rows: Literal["panels", "variants"]
    variants: Mapping[str, Settings]  # name -> the settings that make it
    common: Settings = field(default_factory=dict)  # settings of all runs, under those of the user
    tasks: tuple[str, ...] = ("navigation",)  # unless the user names others
    algorithms: tuple[str, ...] = ("maddpg",)  # unless the user names others
    steps: tuple[int, ...] = ()  # per seed, unless the user names others; empty for the rows of the paper's table
    papers_network: bool = True  # train the paper's perceptron also where the preset has a network over sets
    all_rows: bool = False  # take every row of the paper's table, not only the first
    only: str | None = None  # the one task that the study is about
    teams: tuple[Team, ...] = ()  # rows beside the task itself
    # by task the settings that break its symmetry, and their strengths; empty for other studies
    breakings: Breakings = field(default_factory=dict)
    # by task the variants that its networks do not take, and that are left out unless the user names them
    without: Mapping[str, frozenset[str]] = field(default_factory=dict)
    # of a variant in the paper's numbers, with the fields task, steps, algorithm and value; empty for none
    place: tuple[str, ...] = ()
    mode: Mode = "greedy"  # evaluations that are reported, unless the user asks for others
    # returns whose first passing is reported; by default that which the reference ended with
    thresholds: tuple[float, ...] = ()
    network_cost: bool = False  # whether to state the sizes of the networks, and to draw the paper's numbers as lines
    # whether it compares methods: by the rank-sum test with Holm's correction, with returns at a fifth of the run
    benchmark: bool = False
    # what a run is compared with, in words, where the plain learner is among the runs
    reference: str = "the plain learner (the first run) of the same panel"
    otherwise: str = "the first run of the same panel"  # the same where it is not

    @property
    def varies(self) -> set[str]:
        """The settings that the study sets itself and a user cannot: of those in common the kind of prior alone."""
        chosen = {name for settings in self.variants.values() for name in settings}
        kind = self.common.keys() & {"prior.kind"}  # with another one the title would be of something else
        broken = {f"task.{setting}" for settings in self.breakings.values() for setting in settings}
        return chosen | kind | broken | {name for team in self.teams for name in team.settings}


def _team(agents: int, landmarks: int | None) -> Team:
    label = f"N = {agents}" + (f", {landmarks} landmarks" if landmarks else "")
    place = ("table1", "navigation") if agents == 3 else ("agents", str(agents))
    return Team(label, {"task.num_agents": agents, "task.num_landmarks": landmarks}, place)


KINDS: Mapping[str, StudyKind] = {
    "table1": StudyKind(
        "Table 1 of the paper", rows="panels", variants=PLAIN_AND_ESP, tasks=paper.tasks(), algorithms=ALGORITHMS
    ),
    "agents": StudyKind(
        "Cooperative navigation with 2, 3 and 4 agents, as in the paper's supplement",
        rows="panels",
        variants=PLAIN_AND_ESP,
        algorithms=ALGORITHMS,
        only="navigation",
        # The task's default is as many landmarks as agents, which fits the paper's four agents best; the authors'
        # launcher says three.
        teams=(_team(2, None), _team(3, None), _team(4, None), _team(4, 3)),
    ),
    # figures 5a and 5b, with a copy for every element; then two groups of which each minibatch draws one element
    "ablate-transforms": StudyKind(
        "Number and type of transforms, augmentation alone (figures 5a and 5b)",
        rows="variants",
        common={"prior.kind": "augment"},
        variants={
            "none": {"prior.kind": "none"},
            "rot90": {"prior.transforms": "rot90"},
            "rot90, rot180": {"prior.transforms": "rot90,rot180", "prior.copies": "all"},
            "rot90, rot180, rot270": {"prior.transforms": "rot90,rot180,rot270", "prior.copies": "all"},
            "rot90, flip": {"prior.transforms": "rot90,flip-x", "prior.copies": "all"},
            "C4, drawn": {"prior.transforms": "c4", "prior.copies": "draw"},
            "D4, drawn": {"prior.transforms": "d4", "prior.copies": "draw"},
        },
    ),
    "ablate-coefficient": StudyKind(
        "Coefficient of the consistency loss, loss alone (figure 5c)",
        rows="variants",
        common={"prior.kind": "consistency", **PAPER_PRIOR},
        variants={f"c = {c:g}": {"prior.consistency_coef": c} for c in COEFFICIENTS},
        all_rows=True,
        place=("coefficient, read off figure 5c", "{task}", "{steps}", "{algorithm}", "{value}"),
    ),
    "ablate-modules": StudyKind(
        "Consistency loss and augmentation, each alone and both (figure 6a)",
        rows="variants",
        common=PAPER_PRIOR,
        variants={
            "none": {"prior.kind": "none"},
            "loss": {"prior.kind": "consistency"},
            "augmentation": {"prior.kind": "augment"},
            "both": {"prior.kind": "esp"},
        },
    ),
    "ablate-prior": StudyKind(
        "Each learner with the prior and without it",
        rows="panels",
        variants=PLAIN_AND_ESP,
        algorithms=("mappo",),
        papers_network=False,
    ),
    "ablate-breaking": StudyKind(
        "Methods for imperfect symmetry over the strength of breaking",
        rows="variants",
        variants={
            "plain": {"prior.kind": "none"},
            "ESP": {"prior.kind": "esp"},
            "ESP that fades": {"prior.kind": "esp", "prior.fade": 0.5},
            "auto": {"prior.kind": "auto"},
            "measured weights": {"prior.kind": "esp", "prior.trust": "measured"},
            "compass": {"prior.kind": "esp", "prior.compass": 1.0},
            "relaxed weights": {
                "prior.kind": "none",
                "network.name": "equivariant",
                "network.group": "d4",
                "network.relax": 1.0,
                "network.relaxation": "weights",
            },
        },
        tasks=("navigation", "predator-prey", "formation"),
        algorithms=("mappo",),
        steps=(1_000_000,),
        breakings=BREAKINGS,
        without={"wildlife": frozenset({"compass", "relaxed weights"})},  # its agents see pictures
    ),
    # the standard network, the same with the prior, the equivariant one, and the standard one averaged over the group
    "homomorphic": StudyKind(
        "Symmetry in the network and symmetry in the prior (figure 6b)",
        rows="variants",
        variants={
            "mpn": {"network.name": "mpn", "prior.kind": "none"},
            "mpn-esp": {"network.name": "mpn", "prior.kind": "esp", "prior.transforms": GROUP},
            "empn": {"network.name": "empn", "prior.kind": "none", "network.group": GROUP},
            "mpn-ensemble": {"network.name": "mpn", "prior.kind": "none", "network.symmetrise": GROUP},
        },
        tasks=("wildlife",),
        algorithms=("mappo",),
        steps=(200_000,),
        only="wildlife",
        place=("networks, read off figure 6b", "{task}", "{value}"),
        mode="stochastic",
        thresholds=(2.0,),
        network_cost=True,
    ),
}
_OTHER = StudyKind("", rows="variants", variants={})
_TUNED = replace(
    _OTHER,
    reference="the plain run, tuned beside tuned and default beside default, and of a tuned plain run the default one",
    otherwise="the default run with the same kind of prior",
)
_FIRST = "the first method of the same task"
_BENCHMARK = replace(_OTHER, network_cost=True, benchmark=True, reference=_FIRST, otherwise=_FIRST)


def kind_of(name: str) -> StudyKind:
    """Return what tells a kind of study from others; some are not planned by the catalogue, such as tuned settings."""
    return {"tuned": _TUNED, "symmetry": _BENCHMARK}.get(name) or KINDS.get(name, _OTHER)
