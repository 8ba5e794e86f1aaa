"""For the API pages: the comment behind a field is its documentation, as in ``dt: jax.Array  # () [s] time step``."""

import ast
from typing import Any

import griffe


class FieldComments(griffe.Extension):
    """Fields without a docstring get their trailing comment."""

    def on_attribute_instance(self, *, node: ast.AST | griffe.ObjectNode, attr: griffe.Attribute, **_: Any) -> None:
        """Look behind the end of an assignment."""
        if attr.docstring or not isinstance(node, ast.AnnAssign | ast.Assign) or node.end_lineno is None:
            return
        line = attr.lines_collection[attr.filepath][node.end_lineno - 1]  # pyright: ignore[reportArgumentType]
        # Offsets count bytes.
        behind = line.encode()[node.end_col_offset :].decode().strip()
        if behind.startswith("# ") and not behind.startswith(("# noqa", "# pyright")):
            attr.docstring = griffe.Docstring(behind[2:], lineno=node.lineno, parent=attr)
