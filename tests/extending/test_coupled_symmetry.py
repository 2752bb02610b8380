"""A task whose mirror exchanges agents: declared as one element, checked, refused in parts, trained with."""

from pathlib import Path

import pytest

from esp_cli.symmetry import admit_declared, carried_groups, default_transforms, transform_set
from esp_envs import make
from esp_envs.errors import UserError
from tests.cli.running import TINY_OPTIONS, esp, refused

CRAWL = '''
import torch
from esp_envs import BatchedTask, Continuous, Field, Items, Kind, TaskSettings, TaskSpec, layout


class CrawlSettings(TaskSettings):
    wrong: bool = False


class Crawl(BatchedTask):
    """Four legs, the agents, carry a body; the mirror exchanges left and right ones."""

    Settings = CrawlSettings

    def _describe(self):
        return TaskSpec(
            name="crawl", version=1, convention="speed", num_agents=4, horizon=10,
            symmetry="flip-x*agents-1-0-3-2" if not self.settings.wrong else "flip-x*agents-3-2-1-0",
            settings=self.settings.model_dump(),
            observation=layout(
                Field("own", Kind.PSEUDOSCALAR),
                Field("others", Kind.PSEUDOSCALAR, 3, items=Items.OTHERS),
                Field("velocity", Kind.VECTOR),
            ),
            state=layout(Field("hips", Kind.PSEUDOSCALAR, 4, items=Items.AGENTS), Field("velocity", Kind.VECTOR)),
            action=Continuous(layout(Field("torque", Kind.PSEUDOSCALAR))),
        )

    def _start(self, generator):
        return {"hips": self.draw(4, 1, generator=generator), "velocity": self.draw(1, 2, generator=generator)}

    def _advance(self, world, action):
        hips = world["hips"] + 0.3 * action
        side = torch.tensor([1.0, -1.0, 0.5, -0.5])
        push = torch.stack([(hips[..., 0] * side).sum(-1), hips[..., 0].sum(-1)], -1)
        world["hips"] = hips
        world["velocity"] = 0.8 * world["velocity"] + 0.1 * push[:, :, None]
        return world["velocity"][..., 0, 0], {}

    def _observe(self, world):
        hips, v = world["hips"], world["velocity"]
        others = [[hips[:, :, j] for j in range(4) if j != i] for i in range(4)]
        rows = [torch.cat([hips[:, :, i], *others[i], v[:, :, 0]], -1) for i in range(4)]
        return torch.stack(rows, 2)
'''
DECLARED = "flip-x*agents-1-0-3-2"


@pytest.fixture
def crawl(tmp_path, monkeypatch):
    (tmp_path / "crawl.py").write_text(CRAWL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    esp("tasks", "crawl:Crawl")
    return make("crawl:Crawl", 1, [0]).spec


def test_a_coupled_element_is_carried_whole_and_refused_in_parts(crawl) -> None:
    admit_declared(crawl)
    assert carried_groups(crawl) == (DECLARED,)
    assert default_transforms(crawl) == DECLARED
    assert default_transforms(crawl, weighed=True) == f"d4,{DECLARED}"
    assert transform_set(DECLARED, crawl).names == (DECLARED,)
    for text, sentence in (
        ("flip-x", r"flip-x is no symmetry of its dynamics and reward, which carry flip-x\*agents-1-0-3-2"),
        ("agents-1-0-3-2", "does not say that agents may be exchanged by themselves; use a group within flip-x"),
        ("flip-x*agents-3-2-1-0", "flip-x is no symmetry"),
        ("agents", "does not say that agents may be exchanged by themselves"),
    ):
        with pytest.raises(UserError, match=sentence):
            transform_set(text, crawl)
    assert transform_set("discovered:flip-x*agents-3-2-1-0", crawl).size == 1, "what is vouched for is not held to it"


def test_its_check_holds_and_sees_the_wrong_order(crawl) -> None:
    words = ["check", "symmetry", "crawl:Crawl", "--transforms"]
    assert "broken" not in esp(*words, DECLARED).stdout
    wrong = "flip-x*agents-3-2-1-0"
    assert "broken" in esp(*words, wrong, "--set", "task.wrong=true", code=1).stdout


def test_it_trains_with_what_it_declares(crawl) -> None:
    esp("train", "--task", "crawl:Crawl", *TINY_OPTIONS, "--steps", 150, "--out", "run")
    assert f'"transforms": "{DECLARED}"' in Path("run/config.json").read_text()
    network = ["--prior", "none", "--network", "equivariant", "--set"]
    said = refused("train", "--task", "crawl:Crawl", *network, f"network.group={DECLARED}", "--out", "no")
    assert "choose a finite group that moves no agents" in said
