"""Minimisers that choose among finitely many candidates."""
