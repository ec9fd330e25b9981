"""The notebooks, which are kept without outputs: executed when the site is built, and shown as pages."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"

_TIMEOUT = 120


def executed(path: Path) -> Any:
    """Run a notebook in a kernel of its own, beside its file, and return it with outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell ended with an error.
    """
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=_TIMEOUT, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}})
    return client.execute()


def notebook_pages() -> dict[str, str | bytes]:
    """Content by path of a page for each notebook, and of its pictures."""
    pages: dict[str, str | bytes] = {}
    for path in sorted(FOLDER.glob("*.ipynb")):
        parts: list[str] = []
        for i, cell in enumerate(executed(path).cells):
            if cell.cell_type == "markdown":
                parts.append(cell.source)
                continue
            parts.append(f"```python\n{cell.source}\n```")
            for j, output in enumerate(cell.outputs):
                text, picture = _output(output)
                if picture:
                    name = f"{path.stem}-{i}-{j}.png"
                    pages[f"notebooks/{name}"] = picture
                    text = f"![What the cell draws](./{name})"
                parts.append(text)
        parts.insert(1, f"[Download the notebook](./{path.name}); it was run when this site was built.")
        pages[f"notebooks/{path.stem}.md"] = "\n\n".join(parts) + "\n"
    return pages


def _output(output: Any) -> tuple[str, bytes | None]:
    """Markdown of an output, or a picture."""
    if output.output_type == "stream":
        return f"```text\n{output.text.rstrip()}\n```", None
    data = output.get("data", {})
    if "image/png" in data:
        return "", base64.b64decode(data["image/png"])
    return f"```text\n{data.get('text/plain', '')}\n```", None
