"""What messages say of many things at once."""

from __future__ import annotations

import numpy as np

from rsa_vision.readings import _told


def test_many_images_without_a_partner_are_one_message() -> None:
    place = np.array([[10.2, 20.7], [30.0, 40.0], [50.0, 60.0], [70.0, 80.0]])
    assert _told(place[:1]) == "an image at col 10, row 21 looks like a marker but has no partner"
    assert _told(place[:2]) == "2 images look like markers but have no partner: col 10, row 21; col 30, row 40"
    assert _told(place) == "4 images look like markers but have no partner: col 10, row 21; col 30, row 40; col 50, row 60; ..."
