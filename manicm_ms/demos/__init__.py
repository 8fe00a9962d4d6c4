"""Expert demonstrations: collecting, storing, slicing into windows, inspecting."""
