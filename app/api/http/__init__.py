"""Below the nouns: how a request comes in and an answer goes out, whatever it is about."""
