"""OpenIGTLink, protocol version 3: https://github.com/openigtlink/OpenIGTLink/tree/master/Documents

``message`` makes messages, ``link`` sends them over TCP to many clients.
"""
