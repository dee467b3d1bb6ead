"""The HTTP interface: one module for each noun.

``http`` has all that is below the nouns: ``http.middleware`` stands in front (token, bodies, errors),
``http.application`` before it (repeated requests from memory); ``http.problems`` knows the status of every error,
``http.schemas`` the shapes that nouns share.
"""
