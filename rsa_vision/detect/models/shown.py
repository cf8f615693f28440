"""What marks show at pixels, as functions: how fits are told of the marks beside the one that they are about."""

from __future__ import annotations

from collections.abc import Callable

from rsa_vision.types import Bool, Float

Images = Callable[[Float, Float], Float]
"""Images of some marks at pixels (cols, rows), in film values over the background."""

Beside = Callable[[int, Float, Float], tuple[Float, Bool]]
"""Images of all marks but one ball at pixels (cols, rows) around it, in film values, and the pixels where they are not to be trusted."""
