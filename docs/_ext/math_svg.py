"""Equations as inline SVG, drawn by matplotlib: no LaTeX, no script, no network."""

from __future__ import annotations

import io
import re
from functools import lru_cache
from html import escape
from typing import Any

import matplotlib as mpl
from docutils import nodes
from matplotlib.mathtext import math_to_image

PT_PER_EM = 12.0


@lru_cache(maxsize=512)
def draw(tex: str) -> str:
    """Return one line of TeX as an SVG element, sized in em and standing on the line of the text.

    Parameters
    ----------
    tex : str
        As matplotlib's mathtext knows it, without the dollars.

    Returns
    -------
    str

    Raises
    ------
    ValueError
        If mathtext does not know a symbol: the build fails.
    """
    buffer = io.BytesIO()
    with mpl.rc_context({"mathtext.fontset": "stix", "svg.fonttype": "path", "svg.hashsalt": "math", "font.size": PT_PER_EM}):
        depth_px = math_to_image(f"${' '.join(tex.split())}$", buffer, format="svg", dpi=72, color="#000000")
    svg = buffer.getvalue().decode()
    width, height = (float(re.findall(rf'{side}="([\d.]+)pt"', svg)[0]) for side in ("width", "height"))
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r'<g id="patch_1">.*?</g>', "", body, flags=re.DOTALL)  # the white ground
    body = body.replace("fill: #000000", "")
    size = f'width="{width / PT_PER_EM:.3f}em" height="{height / PT_PER_EM:.3f}em"'
    body = re.sub(r'width="[\d.]+pt"', size, body, count=1)
    body = re.sub(r'(<svg[^>]*?) height="[\d.]+pt"', r"\1", body, count=1)
    style = f'role="img" aria-label="{escape(tex)}" style="vertical-align: {-depth_px / PT_PER_EM:.3f}em"'
    return body.strip().replace("<svg ", f"<svg {style} ", 1)


def visit_inline(writer: Any, node: nodes.math) -> None:
    """Write an equation within the text."""
    writer.body.append(f'<span class="math-svg">{draw(node.astext())}</span>')
    raise nodes.SkipNode


def visit_block(writer: Any, node: nodes.math_block) -> None:
    r"""Write equations on lines of their own (``\\`` separates lines)."""
    lines = "".join(f"<div>{draw(line)}</div>" for line in node.astext().replace(r"\frac", r"\dfrac").split(r"\\") if line.strip())
    writer.body.append(f'<div class="math-svg">{lines}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, Any]:
    """Register the renderer with Sphinx."""
    app.add_html_math_renderer("svg", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
