"""The page of a report: self-contained, escaped, and rendered by a headless Chromium where there is one."""

import re
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from esp_cli.drawing.films import write_gif
from esp_cli.files.formatting import markdown_text
from esp_cli.reporting.collect import Material, collect_study
from esp_cli.reporting.page import FILM, draw_films, write_report
from esp_cli.reporting.tables import Table
from esp_cli.training.folder_names import POLICY
from esp_envs.base import Environment
from esp_envs.registry import task_class
from tests.export.policies import drawn_policy, write_policy
from tests.site.browser import BROWSER, DESKTOP, PHONE, complaints
from tests.studies.small_studies import small_study, write_study

needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium here: .ci/install-chromium, or apt-get")
HOSTILE = "</script><script>console.error('run')</script>&\"'"
HINTS = """<script>
const wide = document.querySelector(".wide"), hints = [];
for (const width of ["", "60px"]) {
  wide.style.width = width;
  dispatchEvent(new Event("resize"));
  hints.push(!wide.previousElementSibling.hidden);
}
document.body.dataset.hints = hints.join();
</script></body>
"""


def material(path: Path, command: str = "esp reproduce table1") -> Material:
    study = small_study(command=command)
    folder = write_study(path / "s", study, {"MAPPO": [-150.0, -160.0, -140.0], "MAPPO-ESP": [-130.0, -120.0, -140.0]})
    return collect_study(folder)


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """The page of a study with a hostile title and one film."""
    path = tmp_path_factory.mktemp("report")
    made = material(path, HOSTILE)
    frames = [np.full((16, 16, 3), shade, np.uint8) for shade in (0, 255)]
    write_gif(made.runs[made.study.cells[1].name] / "film.gif", frames, [0.5, 0.5], frames)
    files = write_report(made, path / "report")
    assert [file.name for file in files] == ["report.html", "report.md", "curves.png", "results.json"]
    return files[0]


class Loads(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.scripts = 0

    def handle_starttag(self, tag, attributes):
        self.scripts += tag == "script"
        self.found += [value for name, value in attributes if name in ("src", "href", "srcset", "data", "action")]


def test_the_page_loads_nothing_and_forbids_it_too(page):
    text = page.read_text()
    loads = Loads()
    loads.feed(text)
    assert loads.found
    assert all(source.startswith(("data:", "#")) for source in loads.found)
    assert "default-src 'none'" in text
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest", text)
    assert loads.scripts == 1, "what was handed in is text, not a script"


def test_every_section_has_a_link_that_leads_to_it(page):
    text = page.read_text()
    places = re.findall(r'<h2 id="([^"]+)">', text)
    assert text.count("<h2") == len(places) == len(set(places))
    assert {"table-1", "films", "runs"} <= set(places)
    assert "figures" not in places, "this study has none"
    for place in places:
        assert text.count(f'href="#{place}"') == 2, "in the list of sections, and beside the heading"
    assert set(re.findall(r'href="#([^"]+)"', text)) == set(places)


def test_charts_say_what_their_axes_are(page):
    text = page.read_text()
    assert text.count('<figure class="chart"') == 1
    drawing = (page.with_name("curves.svg")).read_text()
    assert drawing.count("<!-- environment steps per seed -->") == 1
    assert drawing.count("<!-- greedy return (by hand) -->") == 1


def test_tables_commands_configuration_and_films_are_on_the_page(page):
    text = page.read_text()
    for part in (
        "-150.00 ± 5.77",
        "navigation, 200",
        "MAPPO-ESP",
        "--prior none",
        "&#34;num_agents&#34;: 3",
        "data:image/gif",
    ):
        assert part in text, part
    markdown = page.with_name("report.md").read_text()
    assert "| navigation, 200 | -150.00 ± 5.77 | -130.00 ± 5.77 |" in markdown
    assert "![curves](curves.png)" in markdown


def test_a_study_that_has_not_begun_has_no_report(tmp_path):
    made = material(tmp_path)
    with pytest.raises(ValueError, match="no run of this study has an evaluation yet"):
        write_report(Material(made.study, made.results, {}, {}), tmp_path / "out")


@pytest.mark.parametrize("name", ["report.md", "results.json", "report.html", "curves.png", "curves.pdf"])
def test_a_report_of_somebody_else_is_not_replaced(tmp_path, name):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("mine")
    with pytest.raises(ValueError, match=f"{name} is not of a report by esp; move it away"):
        write_report(material(tmp_path), tmp_path / "out", "paper")
    assert {file.name: file.read_text() for file in (tmp_path / "out").iterdir()} == {name: "mine"}
    (tmp_path / "out" / name).unlink()
    for _ in range(2):
        write_report(material(tmp_path), tmp_path / "out")


def test_a_film_that_is_a_link_or_no_film_stays_out_of_the_page(tmp_path):
    made = material(tmp_path)
    first, second = made.runs.values()
    (tmp_path / "secret").write_bytes(b"GIF8 of mine")
    (first / "film.gif").symlink_to(tmp_path / "secret")
    (second / "film.gif").write_text("text")
    assert "data:image/gif" not in write_report(made, tmp_path / "out")[0].read_text()


def test_a_hostile_label_stays_text_in_markdown(tmp_path):
    assert markdown_text("a|b <i>*c*</i> `d` [e](f)\ng") == r"a\|b \<i>\*c\*\</i> \`d\` [e\](f) g"
    table = Table("t", ("a|b",), (("c|d",),), "e|f").markdown()
    assert table == "| a\\|b |\n| --- |\n| c\\|d |\n\ne\\|f"
    made = material(tmp_path, "esp report '```\n# heading'\x1b]52;c;eA==\x07")
    write_report(made, tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    for page in (text, (tmp_path / "out" / "report.html").read_text()):
        assert "\x1b" not in page
        assert r"\x1b]52;c;eA==\x07" in page
    assert "````sh\nesp report '```\n# heading'" in text


def browse(page: Path, profile: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Open a page without a screen, a network or a past."""
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    flags += ["--disable-component-update", "--disable-sync", "--no-first-run", f"--user-data-dir={profile}"]
    flags += ["--enable-logging=stderr", "--window-size=1300,1800", *options, page.as_uri()]
    return subprocess.run([str(BROWSER), *flags], capture_output=True, text=True, check=True, timeout=240)


@needs_browser
def test_a_browser_renders_it_and_a_table_says_that_it_scrolls(page, tmp_path):
    hinted = page.with_name("hinted.html")
    hinted.write_text(page.read_text().replace("</body>", HINTS))
    done = browse(hinted, tmp_path / "profile", "--dump-dom")
    assert "CONSOLE" not in done.stderr, done.stderr
    assert 'data-hints="false,true"' in done.stdout, "a table says that it scrolls where it does"


@needs_browser
def test_a_broken_script_is_noticed(page, tmp_path):
    broken = page.with_name("broken.html")
    broken.write_text(page.read_text().replace('"use strict";', "nothing.here();"))
    assert "CONSOLE" in browse(broken, tmp_path / "profile", "--dump-dom").stderr


@needs_browser
def test_a_screenshot_has_the_colours_of_the_curves(page, tmp_path):
    picture = tmp_path / "page.png"
    browse(page, tmp_path / "profile", f"--screenshot={picture}")
    with Image.open(picture) as image:
        colours = {colour for _, colour in image.convert("RGB").getcolors(2**24)}
    assert {(0x00, 0x72, 0xB2), (0xE6, 0x9F, 0x00)} <= colours


@needs_browser
@pytest.mark.parametrize("width", [DESKTOP, PHONE])
def test_nothing_is_scrolled_sideways(page: Path, width: int, tmp_path: Path) -> None:
    assert complaints([page], width, tmp_path) == []
    cards, rows = "thead { display: none; }", "<style>thead { display: table-header-group !important; } "
    wide = tmp_path / "wide.html"
    wide.write_text(page.read_text().replace(cards, "").replace("<style>", f"{rows}td {{ min-width: 900px; }} "))
    (tmp_path / "again").mkdir()
    assert "sideways" in "".join(complaints([wide], width, tmp_path / "again"))


def test_a_run_whose_task_does_not_draw_itself_has_no_film_and_the_others_have(tmp_path, monkeypatch):
    runs = {name: tmp_path / name for name in ("unseen", "seen")}
    for kind, run in zip(("choice", "wheels"), runs.values(), strict=True):
        run.mkdir()
        write_policy(drawn_policy(kind, **({"horizon": 2} if kind == "wheels" else {})), run / POLICY)
    monkeypatch.setattr(task_class("navigation"), "scene", Environment.scene)
    done = []
    assert draw_films(runs, done.append) == [runs["unseen"]]
    assert [(run / FILM).exists() for run in runs.values()] == [False, True]
    assert done == [1, 2]
