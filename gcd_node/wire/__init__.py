"""What a message says and how: headers, endpoints, JPEG tables. Nothing here opens a socket."""
