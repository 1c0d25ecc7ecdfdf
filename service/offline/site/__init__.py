"""Several scans as one site: gathered into one store, aligned, compared."""

DRONE = "site"
"""The drone's name in a site's header: the folder between the library and its sites."""

SITE = "site.json"
"""The scans of a site, their motions and ties."""

SAME_VISIT_S = 86_400.0
"""Between the starts of two scans; ground seen further apart may differ, see ``site compare``."""
