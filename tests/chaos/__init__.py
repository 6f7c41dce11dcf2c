"""The whole service, shaken: real processes, real servers, faults at random, and a verdict.

python -m tests.chaos --seed 7 --jobs 200 --minutes 8

plans      what each job asks for, and what must come of it (pure, from the seed)
stages     the real stages' names and artifacts with a body of tenths of a second
schedule   which fault strikes when (pure, from the seed)
doors      ports that lead to a server and can hang, be late, lose answers, answer 500
servers    PostgreSQL, Redis, S3, two APIs and three workers as processes, on small disks
faults     carries a schedule out, and heals everything
load       callers that submit, cancel, retry and delete through both APIs
verdict    what is left in the end: records, history, objects, files, processes
"""
