"""Fuzzing of the command line: damaged files of every kind, and no traceback whatever they hold.

python -m tests.fuzz --inputs 20000 --seed 1 --findings DIR
"""
