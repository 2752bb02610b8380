"""What a user may choose of the prior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from esp_cli.defaults import PriorKind
from esp_cli.files.documents import Strict

# what `kind` "auto" stands for, under what else the user chooses
_AUTO = {"kind": "esp", "trust": "measured", "fade": 0.5}
# settings that another prior has no say in where a user asks for "auto"
SAID_BY_AUTO = frozenset({*_AUTO, "transforms", "weights"})


class PriorConfig(Strict):
    """The symmetry prior: which elements, and how they enter learning.

    `kind` "esp" has both parts, copies and consistency losses; "augment" and "consistency" have one of them; "none" is
    the plain learner. "auto" is short for "esp" with trust "measured" that fades: elements that hold stay, the others
    count by how nearly they hold, and only for the first half of the run. It weighs all of d4, whatever a preset has.
    """

    kind: Literal[PriorKind, "auto"] = Field(
        "esp", description="copies and losses, one of them alone, neither (plain), or auto: what holds in the task"
    )
    transforms: str = Field(
        "d4",
        description="elements, a group, or discovered; paper: rot90; ours: best on navigation; on own tasks: declared",
    )
    copies: Literal["draw", "all", "bandit"] = Field(
        "draw",
        description="draw one element per minibatch; add one copy per element to all; or, for each iteration, the "
        "element or none that training returns were highest after (AdaptAUG)",
    )
    consistency_coef: float = Field(0.1, ge=0, description="c of Eq. 10; paper: 0.5")
    old_log_prob: Literal["copy", "recompute"] = Field(
        "copy", description="pi_old of a copied transition: copied from the original, or recomputed on the copy (Eq. 7)"
    )
    replay: Literal["sampled", "stored"] = Field(
        "sampled",
        description="off-policy learners: copies are made of drawn batches, or stored in the replay (paper: stored)",
    )

    fade: float = Field(
        0.0, ge=0, le=1, description="share of the run over which what is not certain falls to 0, linearly; 0: it stays"
    )
    compass: float = Field(
        0.0,
        ge=0,
        le=1000,
        description="length of axes that policy and critic see too, and that turn with every transform; 0: none",
    )

    trust: Literal["full", "measured", "gate"] = Field(
        "full",
        description="weight of a copy: 1, or by how far its element is broken; gate: in runs of earlier versions only",
    )
    doubt: float = Field(8.0, ge=0, le=1000, description="what is off by b s.d. weighs exp(-doubt b)")
    weights: dict[str, Annotated[float, Field(ge=0, le=1)]] = Field(
        {}, description="weight of each element by its name, 0 leaves it out; filled in where trust is measured"
    )

    @model_validator(mode="before")
    @classmethod
    def _written_out(cls, data: Any) -> Any:
        if not isinstance(data, Mapping) or data.get("kind") != "auto":
            return data
        return {**_AUTO, **{name: value for name, value in data.items() if name != "kind"}}

    @property
    def augments(self) -> bool:
        """Whether copies of transitions enter the learner's own loss."""
        return self.kind in ("esp", "augment")

    @property
    def coefficient(self) -> float:
        """c, or 0 where the consistency loss is off."""
        return self.consistency_coef if self.kind in ("esp", "consistency") else 0.0

    @property
    def needs_declaration(self) -> bool:
        """Whether a task has to declare the elements: not where each is weighed or tried, nor under a compass."""
        return self.trust == "full" and self.copies != "bandit" and not self.compass

    def effective(self) -> PriorConfig:
        """Return this prior with every setting that has no effect set to its default.

        Two priors with the same effective settings train the same, bit for bit. With a coefficient of 0 there is no
        consistency loss; without both parts the kind is "none".
        """
        kind, lost = self._effect()
        kept = {name: value for name, value in self if name not in lost}
        return PriorConfig(**{**kept, "kind": kind})

    def without_effect(self) -> frozenset[str]:
        """Return the names of settings that change nothing beside the others."""
        deciding = {"kind", "consistency_coef"} if self.consistency_coef == 0 else {"kind"}
        doubted = {"doubt"} if self.trust == "measured" and self.weights else set()  # it makes weights that are missing
        return self._effect()[1] - deciding | doubted

    def _effect(self) -> tuple[str, frozenset[str]]:
        """Return the kind that this comes to, and the names of settings that have no effect in it."""
        kind: str = self.kind
        if kind in ("esp", "consistency") and self.consistency_coef == 0:
            kind = "augment" if kind == "esp" else "none"
        sure = bool(self.weights) and all(weight == 1 for weight in self.weights.values())
        lost = of_no_use_to(kind)
        if self.trust == "full":
            lost = lost | {"doubt", "weights"}
        elif sure:  # what is certain does not fade
            lost = lost | {"trust", "doubt", "weights", "fade"}
        return kind, lost


def of_no_use_to(kind: str) -> frozenset[str]:
    """Return the names of settings that change nothing in a prior of this kind."""
    unused = {
        "none": frozenset(PriorConfig.model_fields),
        "augment": frozenset({"consistency_coef"}),
        "consistency": frozenset({"old_log_prob", "replay"}),
    }
    return unused.get(kind, frozenset())
