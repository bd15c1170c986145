//! Snapshots of the acting weights: the newest for whoever watches, and the few that leases still ask for.

use bytes::Bytes;
use rit_proto::v1::{self, weights_server};
use std::{
    collections::VecDeque,
    pin::Pin,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};
use tokio::sync::watch;
use tokio_stream::{Stream, StreamExt as _, wrappers::WatchStream};
use tonic::{Request, Response, Status};

/// The acting weights after so many updates.
#[derive(Clone, Debug, PartialEq)]
pub struct Snapshot {
    /// Updates that made them.
    pub version: u64,
    /// Environment steps collected by then.
    pub env_steps: u64,
    /// Little-endian f32 in the layout's order.
    pub params: Bytes,
}

impl Snapshot {
    /// Copies the acting parameters.
    pub fn new(version: u64, env_steps: u64, params: &[f32]) -> Self {
        Self { version, env_steps, params: params.iter().flat_map(|x| x.to_le_bytes()).collect() }
    }

    /// The parameters again.
    pub fn to_params(&self) -> Vec<f32> {
        let (words, _) = self.params.as_chunks::<4>();
        words.iter().map(|&word| f32::from_le_bytes(word)).collect()
    }

    fn to_message(&self) -> v1::Snapshot {
        v1::Snapshot { version: self.version, params: self.params.clone() }
    }
}

/// Where the trainer puts snapshots and everybody else finds them.
#[derive(Debug)]
pub struct WeightsBoard {
    newest: watch::Sender<Arc<Snapshot>>,
    kept: Mutex<VecDeque<Arc<Snapshot>>>,
    keep: usize,
}

impl WeightsBoard {
    /// A board with its newest snapshot. The oldest version that a lease can ask for is `policy_lag` updates
    /// behind the newest.
    pub fn new(newest: Snapshot, policy_lag: usize) -> Self {
        let newest = Arc::new(newest);
        let kept = Mutex::new(VecDeque::from([Arc::clone(&newest)]));
        Self { newest: watch::Sender::new(newest), kept, keep: policy_lag + 1 }
    }

    /// All that leases can ask for, oldest first.
    pub fn all_kept(&self) -> Vec<Arc<Snapshot>> {
        self.kept().iter().map(Arc::clone).collect()
    }

    /// Puts up a newer snapshot.
    pub fn publish(&self, snapshot: Snapshot) {
        let snapshot = Arc::new(snapshot);
        let mut kept = self.kept();
        kept.push_back(Arc::clone(&snapshot));
        while kept.len() > self.keep {
            kept.pop_front();
        }
        self.newest.send_replace(snapshot);
    }

    /// The newest snapshot.
    pub fn newest(&self) -> Arc<Snapshot> {
        Arc::clone(&self.newest.borrow())
    }

    /// The snapshot of a version, if a lease can still ask for it.
    pub fn get(&self, version: u64) -> Option<Arc<Snapshot>> {
        self.kept().iter().find(|snapshot| snapshot.version == version).map(Arc::clone)
    }

    fn kept(&self) -> MutexGuard<'_, VecDeque<Arc<Snapshot>>> {
        // Nothing that could panic happens under the lock; what it guards is whole in any case.
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// `rit.v1.Weights`.
#[derive(Clone, Debug)]
pub struct WeightsService(pub Arc<WeightsBoard>);

#[tonic::async_trait]
impl weights_server::Weights for WeightsService {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<v1::Snapshot, Status>> + Send>>;

    async fn watch(&self, _: Request<v1::WatchRequest>) -> Result<Response<Self::WatchStream>, Status> {
        let snapshots = WatchStream::new(self.0.newest.subscribe());
        Ok(Response::new(Box::pin(snapshots.map(|snapshot| Ok(snapshot.to_message())))))
    }

    async fn get(&self, request: Request<v1::GetRequest>) -> Result<Response<v1::Snapshot>, Status> {
        let version = request.into_inner().version;
        let newest = self.0.newest().version;
        let snapshot = self.0.get(version);
        let gone = || Status::not_found(format!("weights {version} are not kept; the newest are {newest}"));
        snapshot.map(|snapshot| Response::new(snapshot.to_message())).ok_or_else(gone)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use weights_server::Weights as _;

    fn snapshot(version: u64) -> Snapshot {
        Snapshot::new(version, 10 * version, &[version as f32, -0.5])
    }

    #[tokio::test]
    async fn who_comes_late_gets_the_newest_and_who_is_slow_skips() {
        let board = Arc::new(WeightsBoard::new(snapshot(0), 1));
        board.publish(snapshot(1));
        let service = WeightsService(Arc::clone(&board));
        let mut late = service.watch(Request::new(v1::WatchRequest {})).await.unwrap().into_inner();
        assert_eq!(late.next().await.unwrap().unwrap().version, 1);
        for version in 2..=5 {
            board.publish(snapshot(version));
        }
        let next = late.next().await.unwrap().unwrap();
        assert_eq!((next.version, next.params), (5, snapshot(5).params));
        assert_eq!(board.newest().to_params(), [5.0, -0.5]);
    }

    #[tokio::test]
    async fn what_a_lease_can_ask_for_is_kept() {
        let board = Arc::new(WeightsBoard::new(snapshot(0), 1));
        for version in 1..=5 {
            board.publish(snapshot(version));
        }
        let service = WeightsService(board);
        let get = async |version| service.get(Request::new(v1::GetRequest { version })).await;
        assert_eq!(get(4).await.unwrap().into_inner().version, 4);
        assert_eq!(get(5).await.unwrap().into_inner().version, 5);
        assert_eq!(get(3).await.unwrap_err().code(), tonic::Code::NotFound);
    }
}
