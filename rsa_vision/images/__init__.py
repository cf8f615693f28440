"""Readers of films: any common radiograph file in, one grey array as stored, with what the file says of pixel pitch, patient and time."""

from rsa_vision.images.header import Header
from rsa_vision.images.pitch import require_pitch
from rsa_vision.images.reader import check_file, open_header, read_film

__all__ = ["Header", "check_file", "open_header", "read_film", "require_pitch"]
