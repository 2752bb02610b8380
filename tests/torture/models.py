"""Robot models of strangers through `esp mirror`: nothing is read, written or run that was not named.

Every command runs in a fork with a limit of time and memory, since the reader is not Python. A watch of the kernel on
the folder outside tells whether a file of it was opened.
"""

import ast
import ctypes
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
from itertools import islice
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import mujoco  # noqa: F401 - before the forks

from esp_cli import app
from esp_cli.bodies import Body, auditing, emitting, proven, written  # noqa: F401 - before the forks
from esp_cli.bodies.emitting import HOSTS
from tests.bodies.models import QUADRUPED, biped, legged
from tests.bodies.test_reading import URDF
from tests.forks import fork, wait
from tests.torture.junk import spoil_bytes
from tests.torture.record import Part

ELEMENTS = 10_000  # at most, of one model
BATCH = 5
PROCESSOR_S, MEMORY_BYTES = 30, 4 * 10**9
BASES = (
    biped(),
    biped(right_y=-0.2),
    QUADRUPED,
    legged([(0.3, 0, 0), (-0.15, 0.26, 120), (-0.15, -0.26, 240)]),
    URDF.format(""),
    URDF.format('<mimic joint="left_joint" multiplier="-1"/>'),
)
NAMES = (
    "'''", '"""', "*/", "\n", "\r\n", "\t", "\\", "\\n", "\\x41\\N{DASH}", "{x}", "{{", "%s", "\x85", "\x9b2J",
    "\u2028", "\u202e", "é", "#", "# DATA", "'); import os; os.system('touch pwned') #", '"""\nimport evil\n"""',
    "'\nimport evil", "__class__", "x" * 5000, " ", "[bold]", "../../x", "x/y", "\U0001f600", "None", "0", "-",
)  # fmt: skip
NUMBERS = (
    "nan", "inf", "-inf", "1e308", "1e-320", "-1", "0", "1e999", "", "x", "1 2", "0x10", "NaN 0 0", "1e9 1 1",
    "-1e9 0 0",
    "9" * 400,
)  # fmt: skip
PATHS = (
    "../outside/secret.xml", "../outside/secret.stl", "ROOT/outside/secret.xml", "ROOT/outside/secret.stl", "link.xml",
    "link.stl", "pipe.xml", "pipe.stl", "hole.stl", "hole.xml", "folder.stl", "robot.xml", "part.xml", "mesh.stl",
    "loop.stl", "..\\outside", "..\\outside\\secret.stl", "../outside", "/dev/zero", "/dev/stdin", "/proc/self/environ",
    "/etc/passwd", "file:///etc/passwd", "package://../outside/secret.stl", "missing.stl", ".", "~/.profile", "",
    "%2e%2e/outside/secret.stl", "x" * 300, "x/" * 3000, "é\n.stl",
)  # fmt: skip
PARTS = """
    <include file={}/>
    <asset><mesh name="m" file={}/></asset>
    <asset><mesh name="m" file={} content_type="model/obj"/></asset>
    <asset><texture name="t" type="2d" file={}/></asset>
    <asset><texture name="t" type="cube" fileup={}/></asset>
    <asset><hfield name="h" file={} size="1 1 1 1"/></asset>
    <asset><model name="o" file={}/></asset>
    <asset><skin name="s" file={}/></asset>
    <deformable><skin name="s" file={}/></deformable>
    <worldbody><flexcomp name="f" type="mesh" file={}/></worldbody>
    <extension><plugin plugin={}/></extension>
    <compiler assetdir={}/>
    <compiler meshdir={}/><asset><mesh name="m" file="secret.stl"/></asset>
    <mujoco><compiler meshdir={}/></mujoco>
    <link name="l"><visual><geometry><mesh filename={}/></geometry></visual></link>
    <worldbody><replicate count="99999"><geom size="1"/></replicate></worldbody>
    <worldbody><composite type="cable" count="900 1 1"><geom type="capsule" size=".1"/></composite></worldbody>
    <size memory="900G"/>
    <size memory="20K"/>
    <size memory="200K"/>
    <option timestep="nan"/>
    <custom><text name={0} data={0}/></custom>
""".strip().splitlines()
NUMBERS_OF_ALL = """
from esp_cli import layout
def numbers(body):
    seen = layout(body.velocity(), body.attitude(), body.positions(history=2), body.contacts(body.limbs[1:]))
    return {"policy": seen, "action": layout(body.positions())}
"""


class Models(Part):
    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.seed = scratch / "models", seed
        self.folder = self.scratch / "robot"
        outside = self.scratch / "outside"
        self.folder.joinpath("folder.stl").mkdir(parents=True)
        outside.mkdir()
        (outside / "secret.xml").write_text(
            '<mujocoinclude><worldbody><body name="canary"/></worldbody></mujocoinclude>'
        )
        (outside / "secret.stl").write_bytes(bytes(80) + (4).to_bytes(4, "little") + bytes(200))
        shutil.copy(outside / "secret.stl", self.folder / "mesh.stl")
        for ending in ("xml", "stl"):
            (self.folder / f"link.{ending}").symlink_to(outside / f"secret.{ending}")
            (self.folder / f"loop.{ending}").symlink_to(f"loop.{ending}")
            os.mkfifo(self.folder / f"pipe.{ending}")
            (self.folder / f"hole.{ending}").touch()
            os.truncate(self.folder / f"hole.{ending}", 40 * 2**30)
        (self.folder / "part.xml").write_text('<mujocoinclude><include file="robot.xml"/></mujocoinclude>')
        for module in ("evil", "numpy", "mujoco", "tensordict"):
            (self.folder / f"{module}.py").write_text("open('pwned', 'w')")
        (self.folder / "told.py").write_text(NUMBERS_OF_ALL)
        self._sound = sorted(entry.name for entry in self.folder.iterdir())
        libc = ctypes.CDLL(None, use_errno=True)
        self._watch = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        libc.inotify_add_watch(
            self._watch, bytes(outside), 0x3 | 0x20 | 0x3C0
        )  # read, written, opened, moved, made, removed

    def run(self, number: int) -> str | None:
        rng = random.Random(f"{self.seed} {number}")
        for index in range(BATCH):
            content, self.done = self._model(rng), self.done + 1
            path = self.folder / rng.choice(("robot.xml", "robot.xml", "a'''\n\"\"\"*.xml", "robot.urdf"))
            path.write_bytes(content)
            try:
                wrong = self._try(path, rng)
            finally:
                path.unlink()
            if wrong is not None:
                keep = Path.cwd() / f"torture-model-{self.seed}-{number}-{index}.xml"
                keep.write_bytes(content)
                return f"{path.name!r} {wrong} (kept as {keep.name})"
        return None

    def _model(self, rng: random.Random) -> bytes:
        """Return a model with odd names, hostile parts or damage."""
        text = rng.choice(BASES)
        for name in rng.sample(sorted(set(re.findall(r'name="(\w+)"', text))), rng.choice((0, 1, 3))):
            text = text.replace(f'"{name}"', quoteattr(rng.choice(("", "left", name)) + rng.choice(NAMES)))
        while rng.random() < 0.4:
            value = quoteattr(rng.choice((*PATHS, *PATHS, *NAMES)).replace("ROOT", str(self.scratch)))
            place = rng.choice([m.end() for m in re.finditer("<(mujoco|robot)[^>]*>|</worldbody>|</link>", text)])
            text = text[:place] + rng.choice(PARTS).format(value) + text[place:]
        if rng.random() < 0.4:
            text = self._spoilt(text, rng)
        if rng.random() < 0.05:
            text = f'<!DOCTYPE m [<!ENTITY a "b"><!ENTITY c SYSTEM "/etc/passwd">]>{text.replace(">", ">&a;&c;", 1)}'
        return spoil_bytes(text.encode(), rng) if rng.random() < 0.1 else text.encode()

    def _spoilt(self, text: str, rng: random.Random) -> str:
        """Return a model with elements that have other numbers, that are gone, doubled or nested."""
        try:
            tree = ElementTree.fromstring(text)
        except ElementTree.ParseError:
            return text
        for _ in range(rng.choice((1, 2, 5))):
            parents = [element for element in tree.iter() if len(element)]
            if not parents:  # a change before this one removed all
                break
            parent = rng.choice(parents)
            child = rng.choice(list(parent))
            kind = rng.randrange(4)
            if kind == 0:
                parent.remove(child)
            elif kind == 1:
                parent.extend([child] * (times := rng.choice((1, 30, 3000))))
                if next(islice(tree.iter(), ELEMENTS, None), None) is not None:  # doublings of doublings fill memory
                    del parent[-times:]
            elif kind == 2:
                for _ in range(rng.choice((1, 60, 200))):
                    child.append(child := ElementTree.Element(child.tag, child.attrib))
            elif child.attrib:
                child.set(rng.choice(list(child.attrib)), rng.choice((*NUMBERS, *NAMES[:16])))
        return ElementTree.tostring(tree, encoding="unicode")

    def _try(self, path: Path, rng: random.Random) -> str | None:
        """Run the command, with a file for a loop in most cases, and audit that file; return what is wrong."""
        proof = self.folder / "test_out.py"
        out, host, told = self.folder / "out.py", rng.choice(list(HOSTS)), rng.random() < 0.3
        numbers = ["--order", "told:numbers"] if told else []
        words = ["mirror", path.name, "--json", "-"]
        if rng.random() < 0.8:
            words = ["mirror", path.name, "--emit", host, "-o", out.name, *numbers]
        try:
            code, wrong = self._run(words)
            if wrong is None and out.exists():
                wrong = _unlike_template(out, written) or _unlike_template(proof, proven)
                if wrong is None and code == 0:
                    _, wrong = self._run(["check", "mirror", "out:compute_symmetric_states", path.name, *numbers], (0,))
            left = sorted(entry.name for entry in self.folder.iterdir() if entry not in (path, out, proof))
            if wrong is None and left != self._sound:
                wrong = f"leaves {set(left) - set(self._sound)}"
        finally:
            out.unlink(missing_ok=True)
            proof.unlink(missing_ok=True)
        return None if wrong is None else f"{' '.join(words)[:200]!r}: {wrong}"

    def _run(self, words: list[str], codes: tuple[int, ...] = (0, 1, 2)) -> tuple[int, str | None]:
        """Run a command line in a fork; return its exit code and what is wrong."""

        def job() -> None:
            os.chdir(self.folder)
            sys.dont_write_bytecode = True
            resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_S, PROCESSOR_S))
            signal.alarm(4 * PROCESSOR_S)
            used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES,) * 2)
            app.app(words)

        said, errors = self.scratch / "said.txt", self.scratch / "errors.txt"
        code = wait(fork(job, self.folder, said, errors))
        text, told = said.read_text(), errors.read_text()
        with_watch = ctypes.create_string_buffer(4096)
        if ctypes.CDLL(None).read(self._watch, with_watch, 4096) > 0:
            return code, "a file outside was opened"
        if code not in codes or "Traceback" in told:
            return code, f"exit code {code}: {told[-1000:]}"
        if not all(x.isprintable() or x == "\n" for x in text + told) or "canary" in text:
            return code, f"raw characters of the model are shown: {text + told!r:.1000}"
        if code == 2 and (text or told.count("\n") != 1 or not told.startswith("error: ") or len(told) > 1500):
            return code, f"is not one sentence: {text + told!r:.1000}"
        if "--json" in words and code < 2:
            json.loads(text, parse_constant=lambda word: 1 / 0)
        return code, None


def _unlike_template(file: Path, module: ModuleType) -> str | None:
    """Say how an emitted file differs from its template in anything but literals."""
    template = [ast.dump(node) for node in ast.parse(Path(str(module.__file__)).read_text()).body]
    try:
        made = ast.parse(file.read_text()).body
        data = [node for node in made if isinstance(node, ast.Assign) and ast.dump(node) not in template]
        for node in data:
            ast.literal_eval(node.value)
    except (SyntaxError, ValueError) as error:
        return f"{file.name} is no Python with literals: {error}"
    rest = [ast.dump(node) for node in made if node not in data]
    if not data or rest != [line for line in template if line in rest] or len(template) != len(rest) + 1:
        return f"{file.name} has other statements than its template"
    return None
