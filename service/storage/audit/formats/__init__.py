"""Audit events in other formats: FHIR, DICOM, JSON lines."""
