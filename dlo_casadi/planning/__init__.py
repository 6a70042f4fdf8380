"""Motions of the fixtures after which a cable is at rest."""
