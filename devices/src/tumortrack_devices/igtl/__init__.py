"""OpenIGTLink 3 (github.com/openigtlink/OpenIGTLink, Documents): messages, and the TCP link."""
