"""Tests of the ports to what several servers share: each on its local and its shared adapter."""
