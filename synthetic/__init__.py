"""Films rendered from known geometry: an independent forward model with the truth beside it.

It shares only the vocabulary of ``rsa_vision`` (cages, flags, errors), never its geometry or detection, so that a wrong sign on one side
cannot cancel on the other.
"""
