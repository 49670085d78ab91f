"""The network, plain torch: point operations, backbone, votes, proposals, attention fusion, refinement."""
