"""From a key press on a slider to new pixels, in JupyterLab in a real browser."""

from __future__ import annotations

import tempfile
from pathlib import Path

import nbformat
from nbformat.v4 import new_code_cell, new_notebook

from benchmarks.lab import Lab
from benchmarks.measure import Result, interleaved, ratios

ROUNDS = 25

# the explorer, with exact rays as well, and the same two-panel figure drawn anew by the inline
# backend at every move
CELLS = (
    "%matplotlib inline\nfrom raytransfer.explorer import Explorer\nexplorer = Explorer()\nexplorer",
    "Explorer(exact=True)",
    """
import dataclasses
import ipywidgets
from IPython.display import clear_output, display
from raytransfer import TCD1304
from raytransfer.explorer import Drawing

def draw(change):
    drawing = Drawing(TCD1304)
    drawing.place(dataclasses.replace(explorer.view(), source_dist=slider.value))
    for artists in drawing.moving.values():
        for artist in artists:
            artist.set_animated(False)
    with output:
        clear_output(wait=True)
        display(drawing.figure)

slider = ipywidgets.FloatSlider(value=2000, min=200, max=6000, step=10, description="anew")
output = ipywidgets.Output()
slider.observe(draw, names="value")
draw(None)
ipywidgets.VBox([slider, output])
""",
)

# resolves to the ms from the key press to the frame in which another picture is decoded and shown
WATCH = """
([selector]) => {
  const scope = document.querySelector(selector);
  const source = () => scope.querySelector('img')?.src ?? '';
  window.newPixels = new Promise(resolve => {
    let pressed = NaN;
    document.addEventListener('keydown', () => { pressed = performance.now(); },
      {capture: true, once: true});
    const old = source();
    const observer = new MutationObserver(async () => {
      if (!source() || source() === old) return;
      observer.disconnect();
      await scope.querySelector('img').decode();
      requestAnimationFrame(() => requestAnimationFrame(
        () => resolve(performance.now() - pressed)));
    });
    observer.observe(scope, {attributes: true, childList: true, subtree: true});
  });
}
"""


def run() -> list[Result]:
    """Press the arrow key in turns on the explorers and on the figure drawn anew."""
    with tempfile.TemporaryDirectory() as folder:
        cells = [new_code_cell(source) for source in CELLS]
        kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
        notebook = new_notebook(cells=cells, metadata={"kernelspec": kernel})
        nbformat.write(notebook, Path(folder) / "sliders.ipynb")
        with Lab(Path(folder)) as lab:
            lab.run_all("sliders.ipynb")
            lab.page.wait_for_selector(".jupyter-widgets img")
            for number, output in enumerate(lab.page.query_selector_all(".jp-OutputArea-output")):
                output.evaluate("(element, id) => { element.id = id; }", f"output-{number}")

            def move(description: str, output: str) -> float:
                row = lab.page.locator(f"{output} .widget-slider", has_text=description)
                row.locator(".noUi-handle").first.focus()
                lab.page.evaluate(WATCH, [output])
                lab.page.keyboard.press("ArrowRight")
                took: float = lab.page.evaluate("() => window.newPixels")
                lab.page.wait_for_timeout(100)  # let both come to rest
                return took

            blitted, exact, anew = interleaved(
                ROUNDS,
                lambda: move("source (mm)", "#output-0"),
                lambda: move("source (mm)", "#output-1"),
                lambda: move("anew", "#output-2"),
            )
    return [
        Result("slider: explorer, key press to new pixels", "ms", blitted, "lower"),
        Result("slider: explorer with exact rays", "ms", exact, "lower"),
        Result("slider: exact / paraxial", "", ratios(exact, blitted), "lower", 2),
        Result("slider: the same figure drawn anew by the inline backend", "ms", anew, "lower"),
        Result("slider: explorer / drawn anew", "", ratios(blitted, anew), "lower", 0.25),
    ]
