"""The command line ``fracsim``: one module a group of commands, each with its own parser.

Nothing imports this room.
"""
