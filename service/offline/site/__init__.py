"""Several scans as one site: gathered into one store, aligned, compared."""

DRONE = "site"
"""Of a site's header: the folder between the library and its sites."""

SITE = "site.json"
"""The scans of a site, their motions and ties."""
