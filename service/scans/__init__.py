"""The files of a scan, made from its store alone: cloud, previews, coverage, report."""
