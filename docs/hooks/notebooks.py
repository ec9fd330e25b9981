"""The notebooks: stored without outputs, executed when the site is built, and shown as pages."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"

_TIMEOUT = 600
"""Of a cell in s, also on a busy machine."""


def executed(path: Path) -> Any:
    """Run a notebook in a kernel and a folder of its own, and return it with outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: A cell ended with an error.
    """
    import nbformat
    from nbclient import NotebookClient
    from traitlets.config import Config

    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        # Local sockets, which cannot be reached over a network.
        sockets = Config(
            {"AsyncKernelManager": {"transport": "ipc", "ip": str(Path(folder) / "kernel")}}
        )
        client = NotebookClient(
            notebook,
            config=sockets,
            kernel_name="python3",
            timeout=_TIMEOUT,
            resources={"metadata": {"path": folder}},
        )
        return client.execute()


def notebook_pages(path: Path) -> dict[str, str | bytes]:
    """Run a notebook, and return the content by path of its page and of its pictures.

    Args:
        path: of the notebook.
    """
    pages: dict[str, str | bytes] = {}
    parts: list[str] = []
    for i, cell in enumerate(executed(path).cells):
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for j, output in enumerate(_joined(cell.outputs)):
            text, picture = _output(output)
            if picture:
                name = f"{path.stem}-{i}-{j}.png"
                pages[f"notebooks/{name}"] = picture
                text = f"![Output of the cell](./{name})"
            parts.append(text)
    parts.insert(1, f"[Download the notebook](./{path.name}); it was run when this site was built.")
    pages[f"notebooks/{path.stem}.md"] = "\n\n".join(parts) + "\n"
    return pages


def _joined(outputs: Sequence[Any]) -> list[Any]:
    """Return the outputs of a cell, with all printed text in one piece."""
    printed = [
        output for output in outputs if output.output_type == "stream" and output.name == "stdout"
    ]
    for output in printed[1:]:
        printed[0].text += output.text
    return [*printed[:1], *(output for output in outputs if output.output_type != "stream")]


def _output(output: Any) -> tuple[str, bytes | None]:
    """Return the Markdown of an output, or a picture."""
    if output.output_type == "stream":
        return f"```text\n{output.text.rstrip()}\n```", None
    data = output.get("data", {})
    if "image/png" in data:
        return "", base64.b64decode(data["image/png"])
    html = data.get("text/html", "")
    if html and "<script" not in html:
        return html, None
    return f"```text\n{data.get('text/plain', '')}\n```", None
