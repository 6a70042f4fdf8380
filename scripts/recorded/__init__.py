"""Recordings rendered from a session whose truth is known, as laboratories' programs write them."""
