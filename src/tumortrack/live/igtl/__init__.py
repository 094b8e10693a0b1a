"""OpenIGTLink, protocol version 3: https://github.com/openigtlink/OpenIGTLink/tree/master/Documents

One file per layer: ``crc64``, ``message`` (header, metadata, checksum), ``content`` (what the types
carry), ``link`` (TCP to many clients).
"""
