"""Runs the notebooks and stores their outputs: python scripts/run_notebooks.py (extra `docs`)."""

from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / "notebooks"


def main() -> int:
    import nbformat
    from nbclient import NotebookClient

    for path in sorted(FOLDER.glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
        # Neither times nor versions of this machine belong into the stored file.
        for cell in notebook.cells:
            cell.metadata.clear()
            # Open3D greets whoever imports it in a notebook.
            if cell.cell_type == "code":
                cell.outputs = [output for output in cell.outputs if "Open3D" not in output.get("text", "")]
        notebook.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
        nbformat.write(notebook, path)
        print(path.relative_to(FOLDER.parent))
    return 0


if __name__ == "__main__":
    sys.exit(main())
