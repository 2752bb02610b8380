"""A headless Chromium that opens pages of a built site at a width and says what is wrong with them."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next((path for name in BROWSERS if (path := shutil.which(name))), None)
DESKTOP, PHONE = 1280, 390
AT_ONCE = 12

# One page with a frame for each page of the site: frames have a width of their own, below what a window may have.
FRAMES = """<!doctype html><meta charset="utf-8"><body>
{frames}
<script>
window.onload = () => {{
  const found = [];
  for (const frame of document.querySelectorAll("iframe")) {{
    const page = frame.contentDocument, root = page.documentElement;
    const say = text => found.push(frame.title + ": " + text);
    if (!page.querySelector("h1")) say("has no heading");
    if (root.scrollWidth > root.clientWidth) say("is " + (root.scrollWidth - root.clientWidth) + " px too wide");
    for (const box of page.querySelectorAll(".wide"))
      if (box.scrollWidth > box.clientWidth + 1) say("scrolls " + box.innerText.slice(0, 40) + " sideways");
    for (const picture of page.images) if (!picture.naturalWidth) say("does not show " + picture.getAttribute("src"));
    for (const code of page.querySelectorAll("article pre > code"))
      if (code.scrollWidth > code.clientWidth + 1) say("cuts a line of " + code.innerText.slice(0, 60));
    for (const table of page.querySelectorAll("article table")) {{
      const box = table.parentElement.closest(".md-typeset__scrollwrap, .highlighttable, .highlight") || page.body;
      const cut = table.getBoundingClientRect().right > root.clientWidth + 1;
      if (cut && !["auto", "scroll"].includes(frame.contentWindow.getComputedStyle(box).overflowX)) say("cuts a table");
      if (cut && root.clientWidth > 1000) say("hides the last column of the table of " + table.rows[0].innerText);
      for (const head of table.querySelectorAll("th"))
        if (head.innerText.trim() == "ahead" && head.getBoundingClientRect().right > root.clientWidth)
          say("hides who is ahead");
    }}
  }}
  document.body.innerHTML = "<pre id=found></pre>";
  document.getElementById("found").textContent = JSON.stringify(found);
}};
</script></body>
"""


def opened(address: str, scratch: Path) -> subprocess.CompletedProcess[str]:
    """Open a page without a screen, a network or a past; return what it became and, on standard error, what it said."""
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
    flags += ["--disable-component-update", "--disable-sync", "--allow-file-access-from-files", "--dump-dom"]
    flags += ["--enable-logging=stderr", f"--user-data-dir={scratch / 'profile'}", "--window-size=1500,1000"]
    command = [str(BROWSER), *flags, "--virtual-time-budget=15000", address]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=240)


def complaints(pages: Sequence[Path], width: int, scratch: Path) -> list[str]:
    """Return what a browser finds wrong with pages at a width: too wide, cut tables, lost pictures, console messages.

    Args:
        pages: Files of the site.
        width: Of the view, in CSS pixels.
        scratch: An empty folder.
    """
    found: list[str] = []
    for start in range(0, len(pages), AT_ONCE):
        frames = "\n".join(
            f'<iframe title="{page.stem}" src="{page.as_uri()}" width="{width}" height="900"></iframe>'
            for page in pages[start : start + AT_ONCE]
        )
        frame_page = scratch / "frames.html"
        frame_page.write_text(FRAMES.format(frames=frames), encoding="utf-8")
        done = opened(frame_page.as_uri(), scratch)
        found += [line for line in done.stderr.splitlines() if "CONSOLE" in line]
        answer = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
        assert answer is not None, "the browser gave no answer"
        found += json.loads(html.unescape(answer[1]))
    return found
