"""The ``.oni`` file format alone: codecs, layout, reader, writer; no device and no clock."""
