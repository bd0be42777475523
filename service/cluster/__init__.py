"""Several processes as one service: workers with feeders, a front with REST, a supervisor of local workers.

The database and zenoh are the cluster: no process is needed for the others to work. A worker holds leases of
shards of feeders in PostgreSQL. The front finds the owner of a feeder by the messages of the workers.
"""
