"""The explorer in a real JupyterLab, with a real browser."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from benchmarks.lab import READY, Lab, chromium

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


@pytest.mark.skipif(
    chromium() is None and not os.environ.get("CI"),
    reason="no Chromium: apt install chromium",
)
def test_key_press_moves_slider_and_redraws(tmp_path: Path) -> None:
    """Run all cells, move a slider by keyboard, see another picture and other numbers."""
    shutil.copy(NOTEBOOKS / "05-explorer.ipynb", tmp_path)
    with Lab(tmp_path) as lab:
        lab.run_all("05-explorer.ipynb")
        assert lab.page.locator(".jp-OutputArea-output[data-mime-type*=stderr]").count() == 0
        picture = lab.page.locator(".jupyter-widgets.widget-image").first
        numbers = lab.page.locator(".widget-html", has_text="field edge here").first
        before, before_numbers = picture.screenshot(), numbers.inner_text()

        handle = lab.slider("source (mm)")
        handle.focus()
        value = float(handle.get_attribute("aria-valuenow") or "nan")
        lab.page.keyboard.press("ArrowRight")
        lab.page.wait_for_function(
            "([element, old]) => element.innerText !== old",
            arg=[numbers.element_handle(), before_numbers],
            timeout=30_000,
        )
        assert float(handle.get_attribute("aria-valuenow") or "nan") == value + 10
        assert picture.screenshot() != before

        before = picture.screenshot()
        lab.page.get_by_label("exact rays").first.check()
        exact = lab.page.locator(".widget-html", has_text="median − paraxial").first
        exact.wait_for(timeout=READY)
        assert picture.screenshot() != before
        assert "compiling" not in lab.page.locator(".jupyter-widgets").first.inner_text()
        lab.page.get_by_label("exact rays").first.uncheck()
        exact.wait_for(state="detached", timeout=30_000)
        assert picture.screenshot() == before
