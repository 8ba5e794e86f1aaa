"""The command line: koz train, evaluate, fly, view, export, ..."""
