"""Bytes and links: packets, signing, ports, the messages that we send."""
