"""Sets a document with typst: a template beside the code that uses it, its content as JSON, its own fonts only."""

import json
from datetime import datetime
from importlib.resources import files
from typing import Any, Literal


def typeset(
    package: str,
    template: str,
    document: dict[str, Any],
    *,
    made_at: datetime | None = None,
    form: Literal["pdf", "png"],
) -> bytes:
    """Return a PDF, or a picture of one page at 110 dpi; the same bytes for the same content and time.

    Parameters
    ----------
    package, template
        Where the template lies; it reads the content from ``sys.inputs.document``.
    made_at
        The time that the PDF names.
    """
    import typst  # 60 MB, for those who print

    return bytes(
        typst.compile(
            files(package).joinpath(template).read_bytes(),
            format=form,
            ppi=110.0,
            ignore_system_fonts=True,
            sys_inputs={"document": json.dumps(document)},
            timestamp=None if made_at is None else int(made_at.timestamp()),
        )
    )
