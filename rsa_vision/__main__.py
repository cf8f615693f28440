"""``python -m rsa_vision``."""

from rsa_vision.cli import main

if __name__ == "__main__":
    main()
