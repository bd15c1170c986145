//! A running mean and standard deviation of returns, in whose units a value network works.

/// Exponential averages of returns and of their squares, and how much of them is real. In f64: a return's square may
/// be large beside its variance.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ValueNorm {
    /// Average of returns.
    pub mean: f64,
    /// Average of squared returns.
    pub mean_square: f64,
    /// The averages' weight so far: 0 at first, towards 1.
    pub debias: f64,
}

impl ValueNorm {
    /// Takes in a batch: the average of its returns and that of their squares. `beta` is how much of the old averages
    /// stays.
    pub fn update(&mut self, average: f64, average_square: f64, beta: f64) {
        self.mean = beta * self.mean + (1.0 - beta) * average;
        self.mean_square = beta * self.mean_square + (1.0 - beta) * average_square;
        self.debias = beta * self.debias + (1.0 - beta);
    }

    /// μ: the returns' mean.
    pub fn center(&self) -> f64 {
        self.mean / self.debias.max(1e-5)
    }

    /// The returns' standard deviation, at least 0.1.
    pub fn deviation(&self) -> f64 {
        let center = self.center();
        let variance = self.mean_square / self.debias.max(1e-5) - center * center;
        variance.max(0.01).sqrt()
    }

    /// A return in the value network's units.
    pub fn normalized(&self, value: f64) -> f64 {
        (value - self.center()) / self.deviation()
    }

    /// What the value network said, in the rewards' unit.
    pub fn denormalized(&self, value: f32) -> f64 {
        f64::from(value) * self.deviation() + self.center()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn averages_by_hand() {
        let mut norm = ValueNorm::default();
        assert_eq!((norm.center(), norm.deviation()), (0.0, 0.1));
        // β = 3/4, returns 2 and 6: average 4, of squares 20. The first batch counts whole: variance 20 − 16.
        norm.update(4.0, 20.0, 0.75);
        assert_eq!(norm, ValueNorm { mean: 1.0, mean_square: 5.0, debias: 0.25 });
        assert_eq!((norm.center(), norm.deviation()), (4.0, 2.0));
        assert_eq!((norm.normalized(7.0), norm.denormalized(1.5)), (1.5, 7.0));
        // Then returns 0: mean 3/4, squares 15/4, weight 7/16; variance 60/7 − 144/49.
        norm.update(0.0, 0.0, 0.75);
        assert_eq!(norm, ValueNorm { mean: 0.75, mean_square: 3.75, debias: 0.4375 });
        assert!((norm.deviation().powi(2) - (60.0 / 7.0 - 144.0 / 49.0)).abs() < 1e-12);
    }
}
