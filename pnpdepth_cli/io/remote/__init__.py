"""Files in a store such as S3: addresses, copies of inputs, and outputs that are put whole."""
