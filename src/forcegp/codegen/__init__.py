"""Programs made while forcegp runs: tapes of torch code, and machine code from a C or C++ compiler."""
