"""``python -m app.cli`` is ``fleetmap``."""

from app.cli import main

if __name__ == "__main__":
    main()
