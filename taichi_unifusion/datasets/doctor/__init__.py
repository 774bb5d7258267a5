"""Is a recording all right? What a person should know before mapping it."""
