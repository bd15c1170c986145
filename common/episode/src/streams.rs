//! Where randomness comes from: named streams of the run's seed.
//!
//! Nothing in the system draws from anywhere else, so a result depends on the seed alone: not on time, on
//! threads or on which actor rolled what.

use rand::SeedableRng as _;
use serde::{Deserialize, Serialize};

/// The generator of every stream.
pub type Rng = rand_chacha::ChaCha8Rng;

/// What a stream is for. The numbers are part of a run's meaning: never reuse or renumber one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum Stream {
    /// Initial weights.
    Weights = 1,
    /// Which episodes of replay form a batch; indexed by update.
    Replay = 2,
    /// Which task representations the contrastive loss pairs; indexed by update.
    Pairing = 3,
    /// An episode's task; indexed by episode number.
    Task = 4,
    /// An episode's decision order; indexed by episode number.
    DecisionOrder = 5,
    /// An episode's environment; indexed by episode number.
    Environment = 6,
    /// An episode's exploration; indexed by episode number.
    Exploration = 7,
    /// Which entities REFIL imagines in one group; indexed by update.
    ImaginedGroups = 8,
    /// The noise in ROMA's roles, of the network under training; indexed by update.
    RoleNoise = 9,
    /// The same of the target network.
    TargetRoleNoise = 10,
    /// The order in which an epoch's minibatches take a batch's episodes; indexed by update · epochs + epoch.
    Minibatches = 11,
    /// Which runs a replication of the bootstrap draws; indexed by what is estimated.
    Resampling = 12,
    /// Where points begin on a map of them.
    Embedding = 13,
    /// The decision orders that utilities are averaged over; indexed by episode number.
    CoalitionOrders = 14,
}

/// The seed of a run, or of one evaluation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct RunSeed(pub u64);

impl RunSeed {
    /// The generator of one named stream at one index. Streams that differ in anything are independent.
    pub fn stream(self, stream: Stream, index: u64) -> Rng {
        let mut key = [0; 32];
        key[..8].copy_from_slice(&self.0.to_le_bytes());
        key[8..16].copy_from_slice(&(stream as u64).to_le_bytes());
        key[16..24].copy_from_slice(&index.to_le_bytes());
        Rng::from_seed(key)
    }

    /// A seed for something that needs streams of its own, such as one evaluation of a run.
    pub fn derive(self, name: &str, index: u64) -> Self {
        // FNV-1a over the name, then one draw: names are ours and few, so collisions are not a concern.
        let tag = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
        });
        let mut key = [0xff; 32];
        key[..8].copy_from_slice(&self.0.to_le_bytes());
        key[8..16].copy_from_slice(&tag.to_le_bytes());
        key[16..24].copy_from_slice(&index.to_le_bytes());
        Self(rand::Rng::next_u64(&mut Rng::from_seed(key)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng as _;
    use std::collections::HashSet;

    #[test]
    fn every_name_and_index_is_a_stream_of_its_own() {
        let streams = [Stream::Weights, Stream::Replay, Stream::Pairing, Stream::Task, Stream::DecisionOrder];
        let mut first = HashSet::new();
        for seed in 0..3 {
            for stream in streams {
                for index in 0..50 {
                    assert!(first.insert(RunSeed(seed).stream(stream, index).next_u64()));
                }
            }
        }
    }

    #[test]
    fn a_stream_is_a_fact_of_its_seed() {
        // Pinned: a change here would change what every saved seed means.
        assert_eq!(RunSeed(1).stream(Stream::Weights, 0).next_u64(), 4_344_717_217_939_160_907);
        assert_eq!(RunSeed(7).derive("evaluation", 3).0, 6_893_911_044_260_831_460);
        assert_ne!(RunSeed(7).derive("evaluation", 3), RunSeed(7).derive("evaluation", 4));
        assert_ne!(RunSeed(7).derive("evaluation", 3), RunSeed(7).derive("zero-shot", 3));
    }
}
