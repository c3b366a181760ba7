    // Compensated (Kahan): a lane may add thousands of numbers.
    let y = v - lost;
    let t = total + y;
    lost = (t - total) - y;
    total = t;
