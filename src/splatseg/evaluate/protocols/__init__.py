"""Protocols of published benchmarks as data: what is asked, every choice, the published figures."""
