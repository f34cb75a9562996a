"""Would the tests notice? `make mutants` changes the code in small ways and runs the tests that belong to it
(docs/mutants.md).
"""
