"""What tissue is made of, estimated from how it answers a tool."""
