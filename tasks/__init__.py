"""Tasks, one file each; importing a module registers its environments and expert."""
