"""The grid task x method x seed: resumable jobs, run by any number of processes, and the table that they make."""
