"""The pages and what they load: plain files, served as they are, nothing from anywhere else."""
