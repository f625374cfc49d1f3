"""Definitions of the wire and of files: topics, messages, site file, results.

Imports no other package of ours.
"""
