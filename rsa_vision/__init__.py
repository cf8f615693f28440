"""Folders of radiographs in, three-dimensional marker coordinates with honest uncertainty out.

Every command of ``rsa-vision`` is a function here: :func:`measure`, :func:`detect`, :func:`reconstruct`, :func:`motion`,
:func:`growth`, :func:`precision`, :func:`export`, :func:`report`, :func:`demo`.
They are loaded when first used, so that ``import rsa_vision`` costs nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any, Final

_COMMANDS: Final = frozenset({"measure", "detect", "reconstruct", "report", "demo", "motion", "growth", "precision", "export"})
_LAZY: Final = {
    **dict.fromkeys(_COMMANDS, "rsa_vision.api"),
    "Summary": "rsa_vision.api",
    "propose_segments": "rsa_vision.api",
    "read_segments": "rsa_vision.segments",
    "Cage": "rsa_vision.cages",
    "load_cage": "rsa_vision.cages",
    "builtin_cages": "rsa_vision.cages",
    "draw_cage": "rsa_vision.cage_drawing",
    "Study": "rsa_vision.settings",
    "load_study": "rsa_vision.settings",
    "RsaError": "rsa_vision.errors",
}

__all__ = sorted(_LAZY)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("rsa_vision.provenance").version()
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


class _Command(ModuleType):
    """A module that is also a command: `rsa_vision.detect` and `rsa_vision.report` stay callable when they have been imported."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return getattr(import_module("rsa_vision.api"), self.__name__.rpartition(".")[2])(*args, **kwargs)


class _Package(ModuleType):
    def __setattr__(self, name: str, value: object) -> None:
        if name in _COMMANDS and isinstance(value, ModuleType):
            value.__class__ = _Command
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
