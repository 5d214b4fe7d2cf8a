"""The project's version, apart from everything else so that asking for it loads nothing."""

PROJECT_VERSION = "0.1.0"
