"""Calibrations as other software writes them, read as strictly as our own and never guessed at.

``documents`` reads the texts (JSON, YAML, XML) into plain trees, and numbers and matrices out of those,
``opencv_storage`` and ``ros_camera_info`` know the two dialects, ``conversion`` recognises which one it is.
"""

from typing import TYPE_CHECKING

from engine.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from engine.calibration.formats.conversion import (
        IMPORT_SCHEMA as IMPORT_SCHEMA,
        convert as convert,
        options_of as options_of,
        read_upload as read_upload,
    )

__getattr__, __all__ = lazy_exports(__name__)
