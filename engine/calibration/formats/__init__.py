"""Calibrations as other software writes them, read as strictly as our own and never guessed at.

``documents`` reads the texts (JSON, YAML, XML) into plain trees, ``foreign`` takes numbers and matrices out of those,
``opencv_storage`` and ``ros_camera_info`` know the two dialects, ``convert`` recognises which one it is.
"""
