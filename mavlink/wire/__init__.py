"""Bytes and links: packets, signing, ports, outgoing messages."""
