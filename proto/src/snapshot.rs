//! Acting weights on their way from the learner to an actor: in pieces, since those of a large model are longer than a
//! message may be. Each piece says how long they are all together and the checksum of them all; they come in order.

use crate::v1::SnapshotPiece;
use bytes::{Bytes, BytesMut};

/// Bytes of weights in one piece, far below what a message may have.
pub const PIECE_BYTES: usize = 1 << 20;

/// Whole acting weights.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Snapshot {
    /// Updates that made them.
    pub version: u64,
    /// Little-endian f32 in the layout's order.
    pub params: Bytes,
}

/// Why pieces make no weights.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SnapshotError {
    /// Weights of another model.
    #[error(
        "the learner sends {found} bytes of acting weights, this actor's model has {expected}; use one build and one \
         configuration"
    )]
    Length {
        /// Bytes announced.
        found: u64,
        /// Bytes of the model.
        expected: u64,
    },
    /// A piece is missing, or there twice.
    #[error("weights {version}: a piece begins at byte {found}, where {expected} should come; use one build")]
    Order {
        /// Whose piece it is.
        version: u64,
        /// Where it begins.
        found: u64,
        /// What is there already.
        expected: u64,
    },
    /// Other bytes than those that were sent.
    #[error("weights {0} have not the checksum they were sent with")]
    Altered(u64),
}

/// Cuts weights into pieces; none is copied.
pub fn pieces(version: u64, params: Bytes) -> impl Iterator<Item = SnapshotPiece> + Send + use<> {
    let (bytes_total, checksum) = (params.len(), crc32fast::hash(&params));
    // Weights of no bytes are one piece of none.
    (0..bytes_total.max(1)).step_by(PIECE_BYTES).map(move |begin| SnapshotPiece {
        version,
        bytes_total: bytes_total as u64,
        checksum,
        begin: begin as u64,
        data: params.slice(begin..bytes_total.min(begin + PIECE_BYTES)),
    })
}

/// Puts pieces together.
#[derive(Debug)]
pub struct Assembly {
    expected: u64,
    version: u64,
    params: BytesMut,
}

impl Assembly {
    /// Of weights of so many bytes: no others take memory.
    pub fn new(expected: usize) -> Self {
        Self { expected: expected as u64, version: 0, params: BytesMut::new() }
    }

    /// Takes the next piece; the weights, when it was their last.
    ///
    /// # Errors
    /// When it does not follow the one before, or they are others than those that were sent.
    pub fn push(&mut self, piece: SnapshotPiece) -> Result<Option<Snapshot>, SnapshotError> {
        let SnapshotPiece { version, bytes_total, checksum, begin, data } = piece;
        let expected = self.expected;
        if bytes_total != expected {
            return Err(SnapshotError::Length { found: bytes_total, expected });
        }
        if begin == 0 {
            self.version = version;
            self.params.clear();
        }
        let there = self.params.len() as u64;
        if version != self.version || begin != there || there + data.len() as u64 > expected {
            return Err(SnapshotError::Order { version, found: begin, expected: there });
        }
        // Those of one piece are not copied.
        let params = if data.len() as u64 == expected {
            data
        } else {
            self.params.reserve((expected - there) as usize);
            self.params.extend_from_slice(&data);
            if (self.params.len() as u64) < expected {
                return Ok(None);
            }
            self.params.split().freeze()
        };
        if crc32fast::hash(&params) != checksum {
            return Err(SnapshotError::Altered(version));
        }
        Ok(Some(Snapshot { version, params }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn params(bytes: usize) -> Bytes {
        (0..bytes).map(|at| (at * 31 % 251) as u8).collect()
    }

    #[test]
    fn weights_of_any_length_come_back() {
        for bytes in [0, 4, PIECE_BYTES - 4, PIECE_BYTES, PIECE_BYTES + 4, 3 * PIECE_BYTES + 100] {
            let mut assembly = Assembly::new(bytes);
            // A snapshot that breaks off is forgotten for the next.
            let first = pieces(6, params(bytes)).next().unwrap();
            let _ = assembly.push(first);
            let whole: Vec<_> = pieces(7, params(bytes)).map(|piece| assembly.push(piece).unwrap()).collect();
            assert_eq!(whole.len(), bytes.div_ceil(PIECE_BYTES).max(1));
            assert!(whole[..whole.len() - 1].iter().all(Option::is_none));
            assert_eq!(whole.last().unwrap(), &Some(Snapshot { version: 7, params: params(bytes) }));
        }
    }

    #[test]
    fn what_makes_no_weights_is_named() {
        let bytes = 2 * PIECE_BYTES + 8;
        let pieces: Vec<_> = pieces(7, params(bytes)).collect();
        let other = Assembly::new(bytes + 4).push(pieces[0].clone()).unwrap_err();
        assert_eq!(other, SnapshotError::Length { found: bytes as u64, expected: bytes as u64 + 4 });
        let mut assembly = Assembly::new(bytes);
        assembly.push(pieces[0].clone()).unwrap();
        let order = SnapshotError::Order { version: 7, found: 2 << 20, expected: 1 << 20 };
        assert_eq!(assembly.push(pieces[2].clone()), Err(order));
        let mut mixed = pieces[1].clone();
        mixed.version = 8;
        assert!(matches!(assembly.push(mixed), Err(SnapshotError::Order { version: 8, .. })));
        assembly.push(pieces[1].clone()).unwrap();
        let mut altered = pieces[2].clone();
        altered.data = Bytes::from_static(b"altered!");
        assert_eq!(assembly.push(altered), Err(SnapshotError::Altered(7)));
        let mut long = pieces[0].clone();
        long.data = params(bytes + 1);
        assert!(matches!(assembly.push(long), Err(SnapshotError::Order { .. })));
    }
}
