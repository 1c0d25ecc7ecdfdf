"""The files of a scan, made from its store: cloud, previews, coverage, report."""
