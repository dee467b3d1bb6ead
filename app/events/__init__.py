"""Events of every change, from the store's outbox to Zenoh, and what comes back from robots.

``messages`` what is said · ``bus`` the Zenoh session: publishers, queryables, inbound · ``router`` the router's own
process · ``relay`` outbox -> bus, in order, at least once · ``leader`` the thread that one process of several runs.
"""
