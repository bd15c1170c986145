use super::*;
use crate::blocks::testing::{Named, assert_close, wide};
use rit_nn::{
    View,
    gradcheck::{check_operation, noise, run_operation},
};

/// 5 → 4 → 2 · 2, of inputs in two parts; a floor that some variances reach and others do not.
fn unit() -> (GaussianHead, Named) {
    Named::of(|layout| GaussianHead::new(layout, "role_encoder", 5, 4, 2, FLOOR))
}

const FLOOR: f32 = 0.8;

#[test]
fn mean_and_variance_follow_the_specification() {
    let (head, named) = unit();
    let (first, second) = (noise(2, 6 * 3), noise(3, 6 * 2));
    let (mut mean, mut variance) = (vec![], vec![]);
    for (first, second) in first.chunks(3).zip(second.chunks(2)) {
        let hidden = named.linear("role_encoder.hidden", &wide(&[first, second].concat()));
        let normed = named.layer_norm("role_encoder.norm", &hidden);
        let active: Vec<f64> = normed.iter().map(|&x| if x > 0.0 { x } else { 0.01 * x }).collect();
        let y = named.linear("role_encoder.out", &active);
        mean.extend(&y[..2]);
        variance.extend(y[2..].iter().map(|y| y.exp().max(FLOOR.into())));
    }
    let at_floor = variance.iter().filter(|&&variance| variance == f64::from(FLOOR)).count();
    assert!(at_floor > 0 && at_floor < variance.len(), "{variance:?}");
    let inputs: [(&[f32], usize); 2] = [(&first, 3), (&second, 2)];
    assert_close("mean", &run_operation(&named.params, &inputs, |tape, x| head.forward(tape, x).mean), &mean);
    let ours = run_operation(&named.params, &inputs, |tape, x| head.forward(tape, x).variance);
    assert_close("variance", &ours, &variance);
}

#[test]
fn gradients_are_the_numeric_ones() {
    let (head, named) = unit();
    let drawn = noise(4, 6 * 2);
    check_operation(named.params.len(), &[(6, 3), (6, 2)], |tape, x| {
        let NormalVars { mean, variance } = head.forward(tape, x);
        tape.sample(mean, variance, View::dense(&drawn, 2))
    });
}
