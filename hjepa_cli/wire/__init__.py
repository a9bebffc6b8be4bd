"""The wire room carries closed loops over a real network: no torch, no pickle, plain datagrams.

A device and a controller are state machines that take datagrams and the time and return datagrams;
sockets, clocks and screens surround them. So whatever a network can do is tested without one.
"""
