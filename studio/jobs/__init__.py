"""Jobs: commands that run in the background, one after the other, whatever becomes of who asked for them.

job.py        what a job is, and how it lies on the disk
progress.py   how far a command has come, written by itself
keeper.py     the process that runs one job's command and writes down how it ended
local.py      keepers on this machine
cluster.py    keepers on a Ray cluster
queue.py      all jobs of a data folder: submit, cancel, resume, delete; who runs next
plans.py      what was asked, as a job: train, evaluate, export, demo
"""
