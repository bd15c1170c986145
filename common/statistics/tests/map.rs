//! What a map must show: clusters apart, the same seed the same map.

use rit_episode::{RunSeed, Stream};
use rit_statistics::{silhouette, t_sne};

/// Three clouds in ten dimensions, 20 points each.
fn clouds() -> (Vec<Vec<f32>>, Vec<usize>) {
    let labels: Vec<usize> = (0..60).map(|at| at % 3).collect();
    let point = |(at, &label): (usize, &usize)| {
        (0..10)
            .map(|axis| if axis == label { 10.0 } else { ((at * 7 + axis * 13) % 11) as f32 / 11.0 })
            .collect()
    };
    (labels.iter().enumerate().map(point).collect(), labels)
}

#[test]
fn clusters_stay_apart_and_a_map_is_a_fact_of_its_seed() {
    let (points, labels) = clouds();
    let map = |seed| t_sne::map(&points, 10.0, &mut RunSeed(seed).stream(Stream::Embedding, 0));
    let found = map(1);
    let places: Vec<Vec<f32>> = found.places.iter().map(|place| place.map(|x| x as f32).to_vec()).collect();
    let mean = silhouette(&places, &labels).iter().sum::<f64>() / 60.0;
    assert!(mean > 0.7, "{mean}");
    assert!(found.divergence > 0.0 && found.divergence < 1.0, "{}", found.divergence);
    assert_eq!(found, map(1));
    assert_ne!(found, map(2));
}

#[test]
fn few_points_and_equal_ones_make_a_map_too() {
    for points in [vec![], vec![vec![1.0]], vec![vec![2.0; 3]; 5], vec![vec![0.0], vec![1e6]]] {
        let map = t_sne::map(&points, 30.0, &mut RunSeed(1).stream(Stream::Embedding, 0));
        assert_eq!(map.places.len(), points.len());
        assert!(map.places.iter().flatten().all(|x| x.is_finite()), "{map:?}");
    }
}
