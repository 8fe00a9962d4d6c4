"""The machine: graphics drivers and libraries, devices, and what the doctor says of them."""
