"""What trains most of the time, compiled for the processor at hand: `network.compiled`, on by default in long runs.

Every kernel is one C++ file and one Python file; headers and `library` are shared. The code in torch that a
kernel stands for is its reference in the tests: the results differ by rounding, and so between processors. A seed's do
not depend on the seeds beside it, nor on the number of threads.
"""
