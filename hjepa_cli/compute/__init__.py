"""What computing needs whatever is computed: seeds, processes, devices, interruptions."""
