//! Buffers that are kept from one call to the next: in the steady state nothing is allocated, and nothing is
//! filled that will be written anyway.

use std::ops::{Deref, DerefMut};

/// A stock of buffers.
#[derive(Debug, Default)]
pub struct Scratch {
    free: Vec<Vec<f32>>,
}

/// An owned slice of length `len` whose allocation may be longer.
#[derive(Clone, Debug, Default)]
pub struct Buffer {
    memory: Vec<f32>,
    len: usize,
}

impl Scratch {
    /// A buffer exactly this long with old contents: to be written whole before it is read.
    pub fn take(&mut self, len: usize) -> Buffer {
        // The smallest that is large enough, or else the largest.
        let length = |at: &usize| self.free[*at].len();
        let all = 0..self.free.len();
        let best = all.clone().filter(|at| length(at) >= len).min_by_key(length);
        let best = best.or_else(|| all.max_by_key(length));
        let memory = best.map(|at| self.free.swap_remove(at)).unwrap_or_default();
        let mut buffer = Buffer { memory, len: 0 };
        buffer.fit(len);
        buffer
    }

    /// A buffer of zeros.
    pub fn take_zeros(&mut self, len: usize) -> Buffer {
        let mut buffer = self.take(len);
        buffer.fill(0.0);
        buffer
    }

    /// Takes a buffer back.
    pub fn give(&mut self, buffer: Buffer) {
        self.free.push(buffer.memory);
    }
}

impl Buffer {
    /// Makes it exactly this long. Its old contents stay: to be written whole before it is read. Debug
    /// builds fill it with nonsense, so that tests notice what is read too early.
    pub fn fit(&mut self, len: usize) -> &mut [f32] {
        if self.memory.len() < len {
            self.memory.resize(len, 0.0);
        }
        self.len = len;
        if cfg!(debug_assertions) {
            self.fill(1e30);
        }
        self
    }
}

impl Deref for Buffer {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.memory[..self.len]
    }
}

impl DerefMut for Buffer {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.memory[..self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_come_back_and_the_smallest_that_fits_is_taken() {
        let mut scratch = Scratch::default();
        let (small, large) = (scratch.take(10), scratch.take(1000));
        let (of_small, of_large) = (small.as_ptr(), large.as_ptr());
        scratch.give(large);
        scratch.give(small);
        let again = scratch.take(8);
        assert_eq!((again.as_ptr(), again.len()), (of_small, 8));
        scratch.give(again);
        let middle = scratch.take(500);
        assert_eq!((middle.as_ptr(), middle.len()), (of_large, 500));
        let zeros = scratch.take_zeros(10);
        assert_eq!((zeros.as_ptr(), &zeros[..]), (of_small, &[0.0; 10][..]));
        assert!(scratch.free.is_empty(), "nothing was allocated beside them");
    }
}
