"""Foxglove: published messages in Foxglove's schemas, a live server, a layout."""
