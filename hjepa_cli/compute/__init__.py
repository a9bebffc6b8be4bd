"""All computing needs seeds, processes and devices, and may be interrupted."""
