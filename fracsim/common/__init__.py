"""What every room of fracsim may use: errors, impulses, materials, and the small functions around files and arrays.

Nothing here imports another room.
"""
