"""Prometheus: metrics over HTTP."""
