"""A small study to try the program on: ``rsa-vision demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from synthetic.study import make_study

CAGES: Final[dict[str, dict[str, Any]]] = {
    "1A": {"n_exams": 3, "interval_days": 182, "response": "density", "bits": 16, "bone": True, "scatter": 0.2},
    "1B": {"n_exams": 2, "interval_days": 182, "response": "transmission", "bits": 12},
    "2": {"n_exams": 3, "interval_days": 182, "response": "linear", "bits": 16, "extension": "dcm"},
}


def make_demo(folder: Path, *, rng: np.random.Generator) -> list[Path]:
    """Write a study for each of the cages 1A, 1B and 2, in sub-folders of these names.

    Parameters
    ----------
    folder : Path
    rng : numpy Generator

    Returns
    -------
    list of Path
        The sub-folders; each holds films, ``study.toml`` and ``truth/``.
    """
    for cage, options in CAGES.items():
        make_study(folder / cage, cage, rng=rng, **options)
    return [folder / cage for cage in CAGES]
