"""The figures of report.html and validation.html, one file per subject."""
