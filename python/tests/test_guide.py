"""Runs the guide's Python code as shown on its pages."""

import re

import numpy as np
import pytest
import scipy.ndimage
from conftest import ROOT

import conefield

GUIDE = ROOT / "docs" / "guide"
BLOCK = re.compile(r"(?:<!-- (?P<mark>[^\n]*?) -->\n)?```python\n(?P<code>.*?)```", re.S)


@pytest.mark.parametrize("page", ["python", "writing-stages"])
def test_the_code_of_a_page_runs(page, scan, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"conefield": conefield, "np": np, "scipy": scipy, "scan": scan}
    blocks = [b for b in BLOCK.finditer((GUIDE / f"{page}.md").read_text()) if not (b["mark"] or "").startswith("not run")]
    assert blocks
    for block in blocks:
        code = block["code"].replace("60s", "4s")  # a short budget
        exec(compile(code, f"docs/guide/{page}.md", "exec"), names)
