"""What goes over the wire and into files: topics, messages, site file, results. Imports no other
package of ours.
"""
