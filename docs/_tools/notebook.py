"""A notebook: run it here, in one process, and show it as Markdown.

``python docs/_tools/notebook.py docs/first_steps.ipynb`` runs every cell in a new folder and writes
the outputs into the file. That takes neither a kernel nor a package beyond the project's own.
"""

import ast
import base64
import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any


def execute(notebook: dict[str, Any]) -> dict[str, Any]:
    """Run the code cells in order, in the current directory; the names that they leave.

    What a cell prints, and the value of an expression at its end, become the cell's outputs: text,
    or a PNG where the value is a figure of matplotlib's.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    count = 0
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        count += 1
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            value = _run("".join(cell["source"]), f"cell {count}", names)
        outputs: list[dict[str, Any]] = []
        if printed.getvalue():
            text = printed.getvalue().splitlines(keepends=True)
            outputs.append({"name": "stdout", "output_type": "stream", "text": text})
        if value is not None:
            shown = {"data": _shown(value), "execution_count": count, "metadata": {}}
            outputs.append({**shown, "output_type": "execute_result"})
        cell["outputs"], cell["execution_count"] = outputs, count
    return names


def _run(source: str, name: str, names: dict[str, Any]) -> object:
    """Execute ``source``; the value of its last statement, where that is an expression."""
    tree = ast.parse(source, name)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, name, "exec"), names)
    if last is None:
        return None
    return eval(compile(ast.Expression(last.value), name, "eval"), names)


def _shown(value: Any) -> dict[str, Any]:
    """The value by kind of content, as Jupyter keeps it."""
    if not hasattr(value, "savefig"):
        return {"text/plain": repr(value).splitlines(keepends=True)}
    file = io.BytesIO()
    # Without the software's version, so that the same picture has the same bytes.
    value.savefig(file, format="png", dpi=90, metadata={"Software": None})
    picture = base64.b64encode(file.getvalue()).decode()
    return {"image/png": picture, "text/plain": ["<Figure>"]}


def as_markdown(notebook: dict[str, Any]) -> str:
    """The cells and their outputs as a page."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            text = "".join(output.get("text", data.get("text/plain", "")))
            if "image/png" in data:
                picture = data["image/png"].replace("\n", "")
                parts.append(f"![Output of the cell above](data:image/png;base64,{picture})")
            else:
                parts.append(f"```text\n{text.rstrip()}\n```")
    return "\n\n".join(parts) + "\n"


def main(path: str) -> None:
    """Run the notebook at ``path`` and write its outputs into it."""
    file = Path(path).resolve()
    notebook = json.loads(file.read_text("utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        execute(notebook)
        os.chdir(file.parent)
    file.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
