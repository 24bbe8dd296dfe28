"""Files: images, depth in every format, calibrations, scans, data sets, records and reports."""
