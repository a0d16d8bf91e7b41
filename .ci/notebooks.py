"""Run the notebooks of the documentation and write what they show into them.

Run by `make notebooks`: ``python .ci/notebooks.py``. A notebook that fails stays as it was. Times
of the run are left out, so that only changed results change a file.
"""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat  # pyright: ignore[reportMissingImports]
from nbclient import NotebookClient  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    """Run every notebook in its own folder, from its first cell to its last."""
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        book = nbformat.read(path, as_version=4)
        client = NotebookClient(
            book,
            timeout=300,
            kernel_name="python3",
            record_timing=False,
            resources={"metadata": {"path": str(path.parent)}},
        )
        client.execute()
        # the kernel's own version is of no interest to a reader
        book.metadata["language_info"] = {"name": "python"}
        path.write_text(nbformat.writes(book, indent=1) + "\n", encoding="utf-8")
        print(f"notebooks: {path.relative_to(ROOT)}: done", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
