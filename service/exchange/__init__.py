"""What other systems open: DICOM waveforms and reports, a PACS, RPM ``.vxp``, phase lists and 4-D CT bins."""
