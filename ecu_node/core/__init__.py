"""The node's arithmetic and judgement, without input or output: frames and times in, frames and states out."""
