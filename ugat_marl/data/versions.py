"""Which versions of packages are installed."""

from __future__ import annotations

import importlib.metadata


def version_of(distribution: str) -> str | None:
    """Installed version of a package, or None."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def versions_of(*distributions: str) -> dict[str, str | None]:
    """That of each package, by name."""
    return {name: version_of(name) for name in distributions}
