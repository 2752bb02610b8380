"""What every environment promises, as checks that anybody can run on a task.

    from esp_envs.conformance import PROMISES, Subject, check
    for finding in check(Subject(lambda worlds, seeds: make("navigation", worlds, seeds))):
        print(finding.promise, finding.broken or "holds")

Each promise is one function of a `Subject`. It returns nothing where the promise holds, and raises `Broken` with one
sentence where it does not, or `NotAsked` where the task does not offer what the promise is about.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from esp_envs.conformance import repeating, stepping
from esp_envs.conformance.subject import Broken, NotAsked, Subject
from esp_envs.errors import UserError
from esp_envs.installed import last_line, raised_in

__all__ = ["PROMISES", "QUICK", "Broken", "Finding", "NotAsked", "Subject", "check"]

PROMISES: tuple[Callable[[Subject], None], ...] = (
    stepping.observations_rewards_and_metrics_fit_the_spec,
    stepping.actions_of_heuristics_and_chance_lie_in_the_action_space,
    stepping.episodes_end_when_the_spec_says,
    repeating.the_same_seed_gives_the_same_run,
    repeating.a_seed_alone_equals_itself_among_others,
    repeating.worlds_do_not_touch_each_other,
    repeating.results_are_memory_of_their_own,
    repeating.a_saved_environment_goes_on_bit_for_bit,
    repeating.an_environment_of_another_size_is_refused,
    stepping.a_joint_action_of_the_wrong_shape_is_refused,
    repeating.set_state_reproduces_what_follows,
    repeating.set_state_starts_an_episode,
    stepping.a_scene_can_be_drawn,
)
"""All promises, in the order in which `check` goes through them."""


@dataclass(frozen=True)
class Finding:
    """The result of one promise: `broken` and `not_asked` are sentences; both are None where it holds."""

    promise: str
    broken: str | None = None
    not_asked: str | None = None


QUICK = (stepping.observations_rewards_and_metrics_fit_the_spec, repeating.the_same_seed_gives_the_same_run)
"""Promises that a short look at a task can find broken."""


def check(subject: Subject, promises: Sequence[Callable[[Subject], None]] = PROMISES) -> Iterator[Finding]:
    """Check promises in turn; a task that raises breaks the promise, and only the first where all fail alike."""
    raised: set[str] = set()
    for promise in promises:
        name = promise.__name__.replace("_", " ")
        try:
            promise(subject)
        except NotAsked as reason:
            yield Finding(name, not_asked=str(reason))
        except Broken as failure:
            yield Finding(name, broken=str(failure))
        except (Exception, SystemExit) as failure:
            place = raised_in(failure)
            said = str(failure) if isinstance(failure, UserError) else last_line(failure)
            said += f", in {place}" if place else ""
            kind = re.sub(r"\d+", "", said)  # whichever copy or agent it is
            again = kind in raised
            raised.add(kind)
            yield Finding(name, not_asked="it fails in the same way") if again else Finding(name, broken=said)
        else:
            yield Finding(name)
