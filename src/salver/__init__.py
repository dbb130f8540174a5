"""salver: carry loose objects on a tray, fast and without dropping them, when their parameters are uncertain."""

__version__ = "0.1.0"
