//! The weights that a lease asks for.

use rit_proto::{
    snapshot::{Assembly, Snapshot, SnapshotError},
    transport::{Client, status_words},
    v1::{GetRequest, weights_client::WeightsClient},
};
use tonic::{Code, Status};

/// Why there are no weights.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The learner says so, or has gone.
    #[error("no weights from the learner: {}", status_words(.0))]
    Learner(#[from] Status),
    /// They are no weights of this model.
    #[error(transparent)]
    Snapshot(#[from] SnapshotError),
}

impl WeightsError {
    /// Whether it may be different when the learner is back.
    pub fn may_pass(&self) -> bool {
        match self {
            Self::Learner(status) => matches!(
                status.code(),
                Code::Unavailable
                    | Code::Cancelled
                    | Code::Unknown
                    | Code::ResourceExhausted
                    | Code::DeadlineExceeded
                    // Weights that are not kept any more: the lease is another's by now.
                    | Code::NotFound
            ),
            Self::Snapshot(_) => false,
        }
    }

    /// Whether the same learner would send the same again: weights of another model, or in another order than this
    /// build knows.
    pub fn is_permanent(&self) -> bool {
        matches!(self, Self::Snapshot(SnapshotError::Length { .. } | SnapshotError::Order { .. }))
    }
}

/// Fetches the weights that leases ask for.
pub(crate) struct Weights {
    client: WeightsClient<Client>,
    /// Bytes of the model's acting weights.
    bytes: usize,
}

impl Weights {
    /// Of a model whose acting weights are so many bytes.
    pub(crate) fn new(client: Client, bytes: usize) -> Self {
        Self { client: WeightsClient::new(client), bytes }
    }

    /// The snapshot of this version, which the learner has made before it hands out the lease.
    pub(crate) async fn get(&mut self, version: u64) -> Result<Snapshot, WeightsError> {
        let mut stream = self.client.get(GetRequest { version }).await?.into_inner();
        let mut assembly = Assembly::new(self.bytes);
        loop {
            let Some(piece) = stream.message().await? else {
                return Err(Status::unavailable("its stream has ended").into());
            };
            if let Some(snapshot) = assembly.push(piece)? {
                return Ok(snapshot);
            }
        }
    }
}
