"""Programs made while forcegp runs: graphs of scalars, their derivatives, their C text, and the C compiler."""
